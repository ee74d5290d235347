"""What `--help` of every command says, as sections of a page."""

import importlib
import re
from dataclasses import MISSING, fields
from typing import Any, get_type_hints

from tyro.conf import Positional

from mirror_ppl.commands import COMMANDS
from mirror_ppl.option_help import texts_of, word_of


def commands_sections() -> str:
    """A section a command: what it does, examples, and a table of its options."""
    return "".join(f"\n{section(name)}\n" for name in COMMANDS)


def section(name: str) -> str:
    """The section of one command."""
    module = importlib.import_module(f"mirror_ppl.commands.{name}")
    spoken = f"mirror-ppl {name.replace('_', '-')}"
    examples = [f"# {use}\n{spoken} {args}" for use, args in module.EXAMPLES.items()]
    texts = texts_of(module.Options)
    hints = get_type_hints(module.Options, include_extras=True)
    rows = ["| Option | Default | Meaning |", "|---|---|---|"]
    for field in fields(module.Options):
        option = option_of(field.name, hints[field.name])
        rows.append(f"| `{option}` | {default_of(field.default)} | {escaped(texts[field.name])} |")
    description = escaped(" ".join(module.DESCRIPTION.split()))
    code = "\n".join(["```console", *examples, "```"])
    return "\n\n".join([f"## {spoken}", description, code, "\n".join(rows)])


def option_of(name: str, hint: Any) -> str:
    """How an option, or an argument without one, is written."""
    word = word_of(name, hint)
    if hint == Positional[getattr(hint, "__origin__", hint)]:
        return word or name.upper()
    return f"--{name.replace('_', '-')} {word}"


def default_of(value: Any) -> str:
    """A default as it is shown; nothing where the text says what happens."""
    if value is MISSING:
        return "required"
    if value in (None, ()):
        return ""
    return f"`{' '.join(map(str, value)) if isinstance(value, tuple) else value}`"


def escaped(text: str) -> str:
    """Plain text as Markdown, but for its code; options become code."""
    parts = re.split(r"(`[^`]*`|(?<!\S)--[a-z]+(?:-[a-z]+)*)", text)
    return "".join(
        re.sub(r"([\\|<>*_\[\]])", r"\\\1", part) if place % 2 == 0 else f"`{part.strip('`')}`"
        for place, part in enumerate(parts)
    )
