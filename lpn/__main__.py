"""The console scripts `lpn`, also `python -m lpn`, and `lpn-explorer`."""

from __future__ import annotations

import sys


def run() -> None:
    """Run the command line; if it cannot be imported, report the broken package in one sentence."""
    try:
        from lpn.cli import main
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:  # a broken package may raise anything
        failure = error
    else:
        main.run()
    sys.exit(_report(failure))


def run_explorer() -> None:
    """Run `lpn explore` with the given options, or the `lpn` command that comes first; `uvx lpn-explorer` runs this."""
    first = sys.argv[1] if len(sys.argv) > 1 else "-"
    if first.startswith("-") and first not in ("-h", "--help", "--version"):
        sys.argv.insert(1, "explore")
    run()


def _report(error: Exception) -> int:
    if sys.argv[1:] == ["doctor"]:  # `lpn doctor` works without any package, to say which one is broken
        from lpn.cli.doctor import DoctorCommand

        return DoctorCommand().run()
    from lpn.core.requirements import broken_package

    print(f"lpn: {broken_package(error)}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    run()
