"""Checks that bad input is refused in words that help."""

import re
from typing import Any

import pytest


def assert_refused(words: list[str], function: Any, *args: Any, **kwargs: Any) -> None:
    """A ValueError with all the words: what is wrong, and what is allowed."""
    with pytest.raises(ValueError, match=re.escape(words[0])) as error:
        function(*args, **kwargs)
    message = str(error.value)
    assert all(word in message for word in words), message
