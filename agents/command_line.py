"""Types of options that several commands share; tyro reads them."""

from typing import Annotated

import tyro

# An option without a value.
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]

# --import MODULE, as often as there are modules; `import_modules` takes them.
Imports = Annotated[
    tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="import", metavar="MODULE")
]
