"""What a person did wrong, told in one line."""


class InputError(ValueError):
    """Input that cannot be used: a file, an option, a setting.

    Its text is one line that names the thing, the rule and the value, and the cure if it is known. Commands print
    that line and end with exit code 2; every other error is a fault of this software (`runtime/crash.py`).
    """
