"""Flags whose value is text: LeRobot's parser would decode it as YAML."""

from collections.abc import Collection, Iterator, Sequence

import yaml


def with_literal_text(arguments: Sequence[str], flags: Collection[str]) -> Iterator[str]:
    """Command-line arguments with the values of some flags quoted, so that they are taken as they are.

    YAML would make a number of ``007``, nothing of ``null``, and a mapping of ``task == 'a: b'``.

    Args:
        arguments: As in ``sys.argv``.
        flags: Names of flags, without dashes, with a value in the same argument (``--name=…``) or the next.
    """
    pending = False
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if pending:
            yield _quoted(argument)
            pending = False
        elif name.startswith("--") and name[2:] in flags:
            pending = not equals
            yield f"{name}={_quoted(value)}" if equals else argument
        else:
            yield argument


def _quoted(text: str) -> str:
    return yaml.safe_dump(text, default_style='"', allow_unicode=True, width=float("inf")).rstrip("\n")
