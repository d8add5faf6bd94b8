"""`lpn`, and `python -m lpn`: the command line, or one sentence where a package that all of it needs is missing or broken."""

from __future__ import annotations

import sys


def run() -> None:
    """The console script."""
    try:
        from lpn.cli import main
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:  # a package that is broken, or built for another, raises anything
        failure = error
    else:
        main.run()
    sys.exit(_without(failure))


def _without(error: Exception) -> int:
    if sys.argv[1:] == ["doctor"]:
        from lpn.cli.doctor import Doctor

        return Doctor().run()
    from lpn.core.requirements import flaw

    print(f"lpn: {flaw(error)}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    run()
