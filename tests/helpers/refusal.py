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


def refused(capsys: pytest.CaptureFixture[str], command: Any, *arguments: Any) -> str:
    """Returns the message of a command line that refuses its arguments, on one line."""
    with pytest.raises(SystemExit) as exit_info:
        command([str(argument) for argument in arguments])
    assert exit_info.value.code == 2
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return " ".join((captured.err + captured.out).split())
