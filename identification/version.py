"""The version of the package, said once."""

from typing import Final

VERSION: Final = "0.1.0"
