"""What `--help` of a command says of its options.

tyro derives it from types and values: `--setting {None}|STR ... (default: None)`. Here an option
has a word that says what it takes, the text of its docstring as one paragraph, and a default where
there is one: `--setting SETTING`, and for `--out PATH` the text and `(default: runs/fit)`.
"""

import ast
import inspect
import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

WORDS = {
    "allow_contradictions": "PERCENT",
    "by": "{loo,heldout,evidence}",
    "device": "DEVICE",
    "domain": "WORLD",
    "guide": "ENGINE",
    "human_model": "MODEL",
    "keep": "{means,draws}",
    "kl_measure": "{kl,squared}",
    "models": "MODEL",
    "pooling": "{none,partial}",
    "population": "POPULATION",
    "posterior": "POSTERIOR",
    "posteriors": "POSTERIOR",
    "scheduler": "ADDRESS",
    "setting": "SETTING",
    "sizes": "{shipped,paper}",
    "speech": "{words,gpt2}",
    "what": "{self-model,guide}",
}
"""What options of these names take, in all commands."""
KINDS = {int: "INTEGER", float: "NUMBER", str: "NAME", Path: "PATH"}
"""What others take, by their type."""
MOST_COLUMNS = 100


def registry_for(options_class: type) -> "ConstructorRegistry":
    """The rules by which tyro makes options of a dataclass, with help as above."""
    from tyro.conf import arg
    from tyro.constructors import (
        MISSING_NONPROP,
        ConstructorRegistry,
        StructConstructorSpec,
        StructFieldSpec,
    )

    def default_of(field: Field[Any]) -> Any:
        return MISSING_NONPROP if field.default is MISSING else field.default

    def spec(info: "StructTypeInfo") -> "StructConstructorSpec | None":
        if info.type is not options_class:
            return None
        texts, hints = texts_of(options_class), get_type_hints(options_class, include_extras=True)
        made = []
        for field in fields(options_class):
            shown = arg(
                metavar=word_of(field.name, hints[field.name]),
                help=texts.get(field.name),
                help_behavior_hint=None if field.default not in (None, ()) else "",
            )
            kind: Any = Annotated[hints[field.name], shown]
            made.append(StructFieldSpec(field.name, kind, default_of(field)))
        return StructConstructorSpec(options_class, tuple(made))

    registry = ConstructorRegistry()
    registry.struct_rule(spec)
    return registry


def texts_of(options_class: type) -> dict[str, str]:
    """The docstring of each field, in one line; nothing where there is no source."""
    try:
        source = textwrap.dedent(inspect.getsource(options_class))
    except OSError:
        return {}
    (defined,) = ast.parse(source).body
    assert isinstance(defined, ast.ClassDef)
    found = {}
    for one, after in pairwise(defined.body):
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
            match after:
                case ast.Expr(ast.Constant(str(text))):
                    found[one.target.id] = " ".join(text.split())
    return found


def word_of(name: str, hint: Any) -> str | None:
    """What an option of that name and type takes; None if its values are listed by tyro."""
    hint = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    kinds = [kind for kind in get_args(hint) or (hint,) if kind not in (type(None), ...)]
    word = WORDS.get(name) or KINDS.get(kinds[0])
    several = get_origin(hint) is tuple
    return f"{word} ..." if word and several else word


def description_of(text: str) -> str:
    """A description in lines that fit the terminal, indented: tyro would join others again."""
    columns = min(shutil.get_terminal_size().columns, MOST_COLUMNS)
    lines = textwrap.fill(" ".join(text.split()), columns - 2, break_on_hyphens=False)
    return textwrap.indent(lines, "  ")


def examples_of(prog: str, examples: Mapping[str, str]) -> str:
    """Examples of a command, each under what it is for."""
    lines = [f"  {purpose}:\n    {prog} {args}" for purpose, args in examples.items()]
    return "\n".join(["examples:", *lines])
