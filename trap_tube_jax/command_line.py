"""What the command lines share."""

from typing import Annotated

import tyro

# --import MODULE, as often as there are modules; `imports.import_modules` takes them.
Imports = Annotated[
    tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="import", metavar="MODULE")
]
