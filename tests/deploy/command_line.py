"""The command line, run in this process."""

from typer.testing import CliRunner

from beers_deploy.cli import app


def done(*words: object, code: int = 0) -> str:
    """What a command prints that ends with this exit code."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


def refused(*words: object) -> str:
    """What a command says that ends with 2, its blanks of one length."""
    return " ".join(done(*words, code=2).split())
