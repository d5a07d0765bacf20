"""The command line and the cache: knows the stages by name, not what they compute."""

import sys


def main() -> None:
    """The command `hugs`. Ctrl-C ends it in words also in the first tenths of a second, while the rest is loaded."""
    try:
        from hugs_cli import app

        app.main()
    except KeyboardInterrupt:  # `app.main` has not begun to listen
        print("stopped; finished stages are kept", file=sys.stderr)
        sys.exit(130)
