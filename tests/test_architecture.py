"""The rules that keep the rooms of the package apart, read from the source without importing it."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

PACKAGE = "ugr_lightning"
ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "src" / PACKAGE
FILES = sorted(SOURCE.rglob("*.py"))

# Who may be imported by whom: a room sees those listed and itself, nothing else.
GROUND = {"contract", "embodiment", "errors", "blueprint", "system"}
PARTS = GROUND | {"models", "sim", "data"}
ROOMS = {
    "contract": {"blueprint", "embodiment"},
    "embodiment": set(),
    "errors": set(),
    "blueprint": {"errors"},
    "system": {"errors"},
    "models": GROUND,
    "sim": GROUND,
    "data": GROUND,
    "results": GROUND,
    "rollout": PARTS | {"results"},
    "demos": PARTS | {"rollout"},
    "training": PARTS | {"results", "rollout"},
    "uncertainty": PARTS | {"results", "rollout"},
    "speed": PARTS | {"results", "rollout"},
    "bridges": PARTS | {"results", "rollout"},
    "cli": PARTS | {"results", "rollout", "demos", "training", "uncertainty", "speed", "bridges"},
}
SIMULATORS = {"sapien", "mani_skill", "gymnasium"}
LIGHTNING = {"lightning", "pytorch_lightning"}
ACCOUNTS = {"wandb", "comet_ml", "neptune", "mlflow", "clearml"}
VAGUE_NAMES = {"utils", "util", "common", "helpers", "helper", "misc", "manager"}
VAGUE_SUFFIXES = ("Manager", "Helper", "Handler", "Utils")

# What a reader can open: an equation or a section of the paper, a public repository with its commit, a page of docs/,
# a publication with its year, a specification, an address. Notes that only their writers had are none of these.
OPENABLE = (
    r"paper, (?:section [IVX]+(?:-[A-Z])?|Eq\. \(\d+\))|[\w.-]+/[\w.-]+@[0-9a-f]{7,40}\b|\bdocs/[\w/]+\.md\b"
    r"|\((?:19|20)\d\d\)|Specification \d|https://"
)
UNOPENABLE = (  # notes by their numbered sections, documents that are nowhere here, the home of one machine
    r"\([A-Z]{4,} \d+(?:\.\d+)*\)|\b[A-Z]+_(?:NOTES|PLAN)\b|(?<![\w/])[A-Z]{4,}\.tex\b"
    r"|(?<![\w.])/root/\w"
)
EQUATIONS, SECTIONS = range(1, 10), {"III", "III-A", "III-B", "IV", "IV-A", "IV-B", "IV-C", "V"}
TEXTS = [
    path
    for folder in ("src", "tests", "configs", "notebooks", "docs", "scripts")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in (".py", ".yaml", ".ipynb", ".md", ".txt", ".sh") and path != Path(__file__).resolve()
] + [ROOT / "README.md"]


def module_name(path: Path) -> str:
    """`data.formats.robotwin` for src/ugr_lightning/data/formats/robotwin.py."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(tree: ast.AST, module: str, is_package: bool = False) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything imported anywhere in a file; `from a import b` gives `a.b`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            here = [PACKAGE, *filter(None, module.split("."))]
            keep = len(here) - node.level + is_package if node.level else 0
            base = ".".join([*here[:keep], *filter(None, [node.module])])
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            name = ast.unparse(node.func)
            if name in ("importlib.import_module", "import_module", "__import__"):
                yield node.lineno, str(node.args[0].value)


def imports_at_top_level(tree: ast.Module) -> set[str]:
    """Outer packages that importing the file imports at once; functions and `if TYPE_CHECKING` do not count."""
    todo, found = list(tree.body), set()
    while todo:
        node = todo.pop()
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            todo.extend(node.orelse)
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(str(node.module).split(".")[0])
        else:
            todo.extend(
                child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt | ast.ExceptHandler)
            )
    return found


def violations(tree: ast.AST, module: str, is_package: bool = False) -> list[str]:
    """Every import of a file that the rules forbid, as `line: what`."""
    room = module.split(".")[0]
    found = []
    for line, name in imports(tree, module, is_package):
        outer, _, inner = name.partition(".")
        other = inner.split(".")[0]
        if outer == PACKAGE and other in ROOMS and room in ROOMS and other not in ROOMS[room] | {room}:
            found.append(f"{line}: {room} imports {other}")
        if outer in SIMULATORS and room != "sim":
            found.append(f"{line}: {outer} outside sim")
        if outer in LIGHTNING and room in GROUND | {"models", "sim"}:
            found.append(f"{line}: {outer} in {room}")
        if outer in ACCOUNTS:
            found.append(f"{line}: {outer} needs an account")
    return found


def public_definitions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
    """Public functions and classes of a file, and the public methods of its public classes."""
    todo: list[ast.stmt] = list(tree.body)
    while todo:
        node = todo.pop()
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                todo.extend(node.body)


def is_said_above(node: ast.ClassDef, method: str, ours: dict[str, ast.ClassDef]) -> bool:
    """Whether a base class says what a method does: one of ours that has it, or any of a framework."""
    for base in (re.sub(r"\[.*|.*\.", "", ast.unparse(base)) for base in node.bases):
        if base in ours:
            found = any(isinstance(item, ast.FunctionDef) and item.name == method for item in ours[base].body)
            if found or is_said_above(ours[base], method, ours):
                return True
        elif base not in ("ABC", "Protocol"):
            return True
    return False


@pytest.fixture(scope="module")
def ours() -> dict[str, ast.ClassDef]:
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in FILES]
    return {node.name: node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


@pytest.fixture(params=FILES, ids=lambda path: module_name(path) or PACKAGE)
def file(request: pytest.FixtureRequest) -> tuple[Path, ast.Module]:
    return request.param, ast.parse(request.param.read_text(encoding="utf-8"))


def test_imports_flow_one_way(file):
    path, tree = file
    assert violations(tree, module_name(path), path.name == "__init__.py") == []


def test_every_file_belongs_to_a_room(file):
    path, _ = file
    assert (module_name(path) or PACKAGE).split(".")[0] in {*ROOMS, PACKAGE}


def test_importing_sim_does_not_import_a_simulator(file):
    """Loading a task class may; listing tasks, probing the renderer and naming seeds works where none is installed."""
    path, tree = file
    if path.name == "__init__.py" or module_name(path) == "sim.render":
        assert imports_at_top_level(tree).isdisjoint(SIMULATORS)


def test_files_and_classes_are_named_for_the_noun_they_own(file):
    path, tree = file
    assert VAGUE_NAMES.isdisjoint(path.relative_to(SOURCE).with_suffix("").parts)
    classes = [node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    assert [name for name in classes if name.endswith(VAGUE_SUFFIXES)] == []


def test_every_public_name_says_what_it_is(file, ours):
    """Methods of a subclass may stay silent where the base class, ours or a framework's, defines what they do."""
    path, tree = file
    assert ast.get_docstring(tree) or path.name == "__init__.py", "the file has no docstring"
    overriding = {
        id(item)
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        for item in node.body
        if isinstance(item, ast.FunctionDef) and is_said_above(node, item.name, ours)
    }
    silent = [
        f"{node.lineno}: {node.name}"
        for node in public_definitions(tree)
        if not ast.get_docstring(node) and id(node) not in overriding
    ]
    assert silent == []


def circles(imported: dict[str, set[str]]) -> list[str]:
    """Files that import each other in a circle: those that are left when files without open imports are taken away."""
    left = {name: set(others) & set(imported) - {name} for name, others in imported.items()}
    while free := {name for name, others in left.items() if not others}:
        left = {name: others - free for name, others in left.items() if name not in free}
    return sorted(left)


def names_used_twice(definitions: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Names that several files define, with the files.

    Args:
        definitions: file and name.
    """
    where: dict[str, list[str]] = {}
    for place, name in definitions:
        where.setdefault(name, []).append(place)
    return {name: places for name, places in where.items() if len(places) > 1}


def public_names(paths: Iterable[Path]) -> Iterator[tuple[str, str]]:
    """File and name of each class, and of each public function that is not the `run` of a command."""
    for path in paths:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            kept = isinstance(node, ast.ClassDef) or (isinstance(node, ast.FunctionDef) and node.name[0] != "_")
            if kept and node.name != "run":
                yield module_name(path), node.name


def test_no_files_import_each_other_in_a_circle():
    modules = {module_name(path) for path in FILES}
    imported = {}
    for path in FILES:
        name = module_name(path)
        named = [full for _, full in imports(ast.parse(path.read_text()), name) if full.startswith(f"{PACKAGE}.")]
        found = [full.removeprefix(f"{PACKAGE}.") for full in named]
        imported[name] = {full if full in modules else full.rpartition(".")[0] for full in found}
    assert circles(imported) == []
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}, "e": set()}) == ["a", "b", "c", "d"]


def test_no_name_of_a_class_or_function_means_two_things():
    assert names_used_twice(public_names(FILES)) == {}
    assert names_used_twice([("a", "Model"), ("b", "Model"), ("b", "Other")]) == {"Model": ["a", "b"]}


def unopenable(text: str, path: str = "x.py") -> list[str]:
    """What a text cites and nobody who has only the repository can open."""
    found = re.findall(UNOPENABLE, text)
    if path.endswith(".py"):
        sources = re.findall(r"Source: ((?:.+\n)*?.*?)(?:\n\s*\n|\n?\s*\"\"\"|\Z)", text)
        found += [source for source in sources if not re.search(OPENABLE, source)]
    found += [page for page in re.findall(r"(?<![\w/])docs/[\w/]+\.md", text) if not (ROOT / page).is_file()]
    for cited in re.findall(r"[Pp]aper(?:'s|,) Eq\. (\(\d+\)(?:(?:,| to| and) \(\d+\))*)", text):
        found += [f"Eq. {n}" for n in re.findall(r"\d+", cited) if int(n) not in EQUATIONS]
    return found + [name for name in re.findall(r"paper, section ([IVX]+(?:-[A-Z])?)", text) if name not in SECTIONS]


def test_every_source_can_be_opened():
    found = {str(path.relative_to(ROOT)): unopenable(path.read_text(encoding="utf-8"), path.name) for path in TEXTS}
    assert {path: what for path, what in found.items() if what} == {}


@pytest.mark.parametrize(
    "text",
    [
        "(NOTES 3.1)",
        "as measured in SIM_NOTES",
        "DRAFT.tex, section on implementation",
        "measured in /root/notes",
        "    Source: the original code.\n    ",
        "Source: lerobot, src/lerobot/policies/act",
        "Source: docs/no_such_page.md.",
        "paper, Eq. (10)",
        "paper, section VII",
    ],
)
def test_a_source_that_nobody_can_open_is_found(text):
    assert unopenable(text)


@pytest.mark.parametrize(
    "text",
    [
        "Source: paper, Eq. (4) and (5).",
        "Source: paper, section IV-A; tonyzhaozh/act@742c753,\n        utils.py.",
        "Source: docs/data.md.",
        "Source: Holm (1979).",
    ],
)
def test_a_source_that_everybody_can_open_is_not(text):
    assert unopenable(text) == []


@pytest.mark.parametrize(
    ("module", "line", "complaint"),
    [
        ("data.chunks", "from ugr_lightning.models.act import ACT", "data imports models"),
        ("models.act", "import ugr_lightning.sim.robot", "models imports sim"),
        ("models.act", "import lightning.pytorch as pl", "lightning in models"),
        ("sim.tasks.click", "from ...rollout import runner", "sim imports rollout"),
        ("rollout.runner", "from ugr_lightning import training", "rollout imports training"),
        ("training.module", "import ugr_lightning.cli.main", "training imports cli"),
        ("rollout.runner", "def f():\n    import sapien.core", "sapien outside sim"),
        ("training.module", "importlib.import_module('mani_skill.envs')", "mani_skill outside sim"),
        ("training.callbacks.rollout", "from wandb import init", "wandb needs an account"),
    ],
)
def test_the_rules_notice_a_wrong_import(module, line, complaint):
    assert any(complaint in found for found in violations(ast.parse(line), module))


def test_the_rules_allow_what_the_design_draws():
    allowed = "from ugr_lightning.contract import Batch\nfrom .formats import robotwin\nimport torch"
    assert violations(ast.parse(allowed), "data.episode") == []
    assert violations(ast.parse("from ugr_lightning.sim.simulator import Simulator"), "rollout.runner") == []


def test_no_text_of_the_package_asks_for_an_account(file):
    path, _ = file
    assert "wandb" not in path.read_text(encoding="utf-8").lower()


def test_listing_the_simulation_does_not_load_a_simulator():
    """Proved by running it, because an import may hide behind another."""
    program = (
        "import sys; import ugr_lightning.sim, ugr_lightning.sim.tasks as tasks, ugr_lightning.sim.seeds;"
        "import ugr_lightning.sim.render, ugr_lightning.sim.sapien_simulator, ugr_lightning.sim.registry as registry;"
        "tasks.task_names(), tasks.task_summaries(), registry.simulator_of('aloha_transfer_cube');"
        f"sys.exit(', '.join(sorted({SIMULATORS | {'gym_aloha', 'dm_control'}!r} & set(sys.modules))) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
