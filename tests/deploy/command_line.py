"""Functions that run the command line in this process."""

from typer.testing import CliRunner

from beers_deploy.cli.commands import app


def done(command: object, *words: object, code: int = 0) -> str:
    """Run a command, check its exit code, and return its output.

    Args:
        command: its first words, none of which contains a blank.
        words: more words.
        code: the expected exit code.
    """
    result = CliRunner().invoke(app, [*str(command).split(), *map(str, words)])
    assert result.exit_code == code, result.output
    return result.output


def refused(*words: object) -> str:
    """Return the output of a command that ends with 2, with single spaces between words."""
    output = done(*words, code=2)
    assert "Traceback" not in output
    return " ".join(output.split())
