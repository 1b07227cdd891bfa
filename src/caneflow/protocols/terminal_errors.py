"""What a serial port that is gone raises beside OSError: of Linux and macOS; Windows has no such module."""

try:
    from termios import error as _error
except ModuleNotFoundError:
    TERMINAL_ERRORS: tuple[type[Exception], ...] = ()
else:
    TERMINAL_ERRORS = (_error,)
