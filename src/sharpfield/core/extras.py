"""Optional packages: imported where they are used, with an error that names the extra."""

import importlib
from types import ModuleType

from sharpfield.core.errors import MissingExtra


def need(package: str, *, extra: str, purpose: str) -> ModuleType:
    """Import an optional package.

    Args:
        package: Import name, e.g. `hdf5plugin`.
        extra: The extra of `sharpfield` that installs it.
        purpose: What the user was about to do, to begin the error message.

    Raises:
        MissingExtra: The package is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as missing:
        if missing.name != package.partition(".")[0]:
            raise
        raise MissingExtra(package, extra=extra, purpose=purpose) from None
