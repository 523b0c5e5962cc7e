"""``python -m sysid`` is the ``sysid`` command."""

from sysid.cli.main import command

if __name__ == "__main__":
    command()
