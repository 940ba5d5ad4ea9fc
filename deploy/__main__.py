"""Entry point of the command line: `beers-deploy`, or `python -m beers_deploy` if scripts are not
on the PATH.
"""

import sys
import traceback

CRASHED = 70
"""The same as in `profiles.errors`. That module loads NumPy, which may be the library that does not
load."""
INTERRUPTED = 130
"""The same as in `cli.run`, for Ctrl-C while libraries are loaded."""


def main() -> None:
    """Run the command line `beers-deploy`.

    The exit code is 70 if a library of the installation does not load. Python's own code for an
    uncaught error, 1, would mean that a gate failed.
    """
    try:
        from beers_deploy.cli.commands import app

        app(prog_name="beers-deploy")
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:  # noqa: BLE001 - Python itself would end with 1
        traceback.print_exc()
        print(  # noqa: T201
            f"beers-deploy: this installation does not work, install it again: {error!a}",
            file=sys.stderr,
        )
        sys.exit(CRASHED)


if __name__ == "__main__":
    main()
