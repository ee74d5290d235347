"""The reference: public names are there, documented, and on its pages; pages are in the site."""

import ast
import importlib
import importlib.util
import inspect
import pkgutil
import re
import sys

import pytest
from paths import ROOT

import mirror_ppl
from mirror_ppl.commands import COMMANDS

REFERENCE = ROOT / "docs/reference"
PACKAGES = ["domains", "models", "inference", "communication", "data", "plots"]
PUBLIC = ["mirror_ppl", *(f"mirror_ppl.{name}" for name in PACKAGES)]
LAZY = ["mirror_ppl.inference", "mirror_ppl.plots"]
every_package = pytest.mark.parametrize("package", PUBLIC)


def page_of(package):
    return (REFERENCE / f"{package.rpartition('.')[2]}.md").read_text()


def public_members(kind):
    """Methods and properties of a class that are its own, by name."""
    return {
        name: member.fget if isinstance(member, property) else inspect.unwrap(member)
        for name, member in vars(kind).items()
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property))
    }


@every_package
def test_public_names_are_there_and_documented(package):
    module = importlib.import_module(package)
    assert module.__doc__
    assert len(set(module.__all__)) == len(module.__all__)
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        found = getattr(module, name)
        if not (inspect.isclass(found) or inspect.isfunction(found)):
            continue
        assert found.__module__.startswith("mirror_ppl.")
        assert found.__doc__ and not found.__doc__.startswith(f"{name}("), name
        for member, function in public_members(found).items() if inspect.isclass(found) else ():
            # An override may leave it to what it overrides.
            assert inspect.getdoc(function) or _inherited(found, member), f"{name}.{member}"


def _inherited(kind, member):
    return any(getattr(vars(base).get(member), "__doc__", None) for base in kind.__mro__[1:])


@every_package
def test_every_public_name_is_on_its_page(package):
    """Sphinx documents classes and functions of a whole package; data has to be named."""
    module, page = importlib.import_module(package), page_of(package)
    whole = f".. automodule:: {package}\n   :imported-members:" in page
    for name in module.__all__:
        found = getattr(module, name)
        if not (whole and (inspect.isclass(found) or inspect.isfunction(found))):
            assert f".{name}\n" in page or f"`{name}`" in page, name


@pytest.mark.parametrize("package", LAZY)
def test_names_that_are_imported_when_they_are_used(package):
    """Three lists of them agree: what runs, what types are checked by, what is public."""
    module = importlib.import_module(package)
    (block,) = (
        node for node in ast.parse(inspect.getsource(module)).body if isinstance(node, ast.If)
    )
    typed = {alias.name: line.module for line in block.body for alias in line.names}
    places = {name: f"{package}.{place}" for name, place in module._PLACES.items()}
    assert typed == places
    assert list(places) == module.__all__
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        module.nothing  # noqa: B018


# --- roles in docstrings ----------------------------------------------------------------------

ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod|obj):`~?([^`]+)`")


def docstrings(node, scope=()):
    """Docstrings of a module, of what is in it, and of its data, each with the names around it."""
    for one in ast.iter_child_nodes(node):
        if isinstance(one, ast.ClassDef | ast.FunctionDef):
            yield from docstrings(one, (*scope, one.name))
        elif isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant):
            yield scope, str(one.value.value)


def has(found, path):
    """Whether a name with dots is of something; fields of classes without a value count, too."""
    for part in path.split("."):
        fields = getattr(found, "__annotations__", {})
        if not hasattr(found, part):
            return part in fields
        found = getattr(found, part)
    return True


def is_imported(name):
    """Whether a name with dots is a module, or in one."""
    module, dot, rest = name.partition(".")
    found = importlib.import_module(module) if module == "mirror_ppl" else None
    while found is not None and rest and not has(found, rest):
        part, dot, rest = rest.partition(".")
        module = f"{module}.{part}"
        known = importlib.util.find_spec(module)
        found = None if known is None else importlib.import_module(module)
    return found is not None


def test_roles_in_docstrings_name_what_is_there():
    """Sphinx takes names that it does not know for code."""
    wrong = []
    for info in pkgutil.walk_packages(mirror_ppl.__path__, "mirror_ppl."):
        module = importlib.import_module(info.name)
        for scope, text in docstrings(ast.parse(inspect.getsource(module))):
            around = [module]
            for name in scope:
                around.append(getattr(around[-1], name, None))
            for name in ROLE.findall(text):
                if not (any(has(one, name) for one in around) or is_imported(name)):
                    wrong.append(f"{'.'.join([info.name, *scope])}: {name}")
    assert not wrong


# --- the site ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def commands_page():
    spec = importlib.util.spec_from_file_location(
        "commands_page", ROOT / "docs/_site/commands_page.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_commands_are_in_the_reference_as_in_their_help(commands_page):
    text = commands_page.commands_sections()
    for name in COMMANDS:
        assert f"\n## mirror-ppl {name.replace('_', '-')}\n" in text
    assert (
        "| `--out PATH` | `runs/fit` | Folder for the results; made if it is not there. |" in text
    )
    assert "| `--rounds INTEGER ...` | `1 5 20` |" in text
    assert "| `--setting SETTING` |  | " in text
    assert "| `POSTERIOR ...` |  | Two or more posteriors" in text
    assert "| `STUDY` | required | What is compared. |" in text
    assert "by the name of\nthe" not in text
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert all(row.replace(r"\|", "").count("|") == 4 for row in rows)


def test_text_is_escaped_but_not_its_code(commands_page):
    told = commands_page.escaped("a_b | `a_b --c` <c> of --some-one, --two.")
    assert told == r"a\_b \| `a_b --c` \<c\> of `--some-one`, `--two`."


def test_every_page_is_in_the_site():
    pytest.importorskip("sphinx")
    names = {"__file__": str(ROOT / "docs/_site/conf.py")}
    path = list(sys.path)
    try:
        exec((ROOT / "docs/_site/conf.py").read_text(), names)
    finally:
        sys.path[:] = path
    lists = [*names["SITE"].values(), *names["BELOW"].values()]
    shown = [entry.rpartition("<")[2].strip("</>") for entries in lists for entry in entries]
    assert len(set(shown)) == len(shown)
    pages = {f"docs/{page.stem}" for page in (ROOT / "docs").glob("*.md")}
    pages |= {f"docs/reference/{page.stem}" for page in REFERENCE.glob("*.md")}
    pages |= {f"notebooks/{page.stem}" for page in (ROOT / "notebooks").glob("*.ipynb")}
    assert set(shown) == pages | {"self", "CHANGELOG", "CONTRIBUTING", "docs/results/*"}
    assert {f"docs/reference/{page}" for page in ("mirror_ppl", "commands", *PACKAGES)} <= pages
