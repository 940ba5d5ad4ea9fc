"""The program with studies of next to nothing: `python -m tests.docs.small_study tradeoff`."""

from deploy.cli import app
from tests.deploy.tradeoff.small import small_studies

if __name__ == "__main__":
    with small_studies():
        app()
