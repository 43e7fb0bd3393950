"""What the console commands share: a configuration from flags and YAML, and errors as one sentence."""

import sys
from collections.abc import Callable
from pathlib import Path

import draccus


def run[Config](config_class: type[Config], action: Callable[[Config], str]) -> None:
    """Parse `config_class` from the command line and print what `action` returns; exit with 1 if it refuses.

    A `ValueError` or `OSError` is the user's to read and is printed without a traceback; any other exception is a
    defect and keeps it.
    """
    try:
        print(action(_parse(config_class)))
    except (ValueError, OSError) as error:
        sys.exit(f"{Path(sys.argv[0]).stem}: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit(130)


def _parse[Config](config_class: type[Config]) -> Config:
    try:
        return draccus.parse(config_class)
    except draccus.ParsingError as error:
        cause = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        raise ValueError(str(cause)) from None
    except TypeError:  # draccus merges the file's fields with the flags before it looks at them
        raise ValueError("The file of --config_path is empty or not a mapping of fields.") from None
