"""The command line and the cache: knows the stages by name, not what they compute."""

import sys


def main() -> None:
    """The command `hugs`. Ctrl-C ends it with a message even in the first tenths of a second, while it loads."""
    try:
        from hugs_cli import app

        app.main()
    except KeyboardInterrupt:  # `app.main` has not begun to listen
        print("stopped; finished stages are kept", file=sys.stderr)
        sys.exit(130)
