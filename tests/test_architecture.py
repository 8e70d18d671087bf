"""The layout of the project: imports point one way, importing does nothing, and data is never executed."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# A module imports only from modules listed before it, so a new file goes below all that it imports.
# A package's own name is its __init__.py, which re-exports what stands above.
ORDER = [
    "larp_model.errors",
    "larp_model.files",
    "larp_model.runtime",
    "larp_model.names",
    "larp_model.scene",
    "larp_model.anatomy",
    "larp_model.bodies",
    "larp_model.mjcf",
    "larp_model.state",
    "larp_model.rotation",
    "larp_model.linalg",
    "larp_model.physics.kinematics",
    "larp_model.physics.collision",
    "larp_model.detection",
    "larp_model.physics.contact",
    "larp_model.physics.articulated",
    "larp_model.physics.admittance",
    "larp_model.physics.ground",
    "larp_model.physics.motion",
    "larp_model.physics.ball",
    "larp_model.physics.response",
    "larp_model.physics.impact",
    "larp_model.physics.step",
    "larp_model.physics",
    "larp_model.networks",
    "larp_model.learned.model",
    "larp_model.learned.residual",
    "larp_model.learned.paper",
    "larp_model.learned",
    "larp_model.designs",
    "larp_model.weights",
    "larp_model.sharding",
    "larp_model.linearization",
    "larp_model.expected_error",
    "larp_model.simulator",
    "larp_model.losses",
    "larp_model.step_examples",
    "larp_model.training",
    "larp_model.prediction",
    "larp_model.launches",
    "larp_model.evaluation",
    "larp_model.engines.mujoco",
    "larp_model.engines.bullet",
    "larp_model.engines.episodes",
    "larp_model.engines",
    "larp_model",
    "larp_model.commands",
    "mpc.dynamics",
    "mpc.feedback",
    "mpc.estimator",
    "mpc.timeline",
    "mpc.spline",
    "mpc.cost",
    "mpc.search",
    "mpc.damping",
    "mpc.cem",
    "mpc.mppi",
    "mpc.gradient",
    "mpc.gauss_newton",
    "mpc.verified",
    "mpc.fallback",
    "mpc.problem",
    "mpc.batch",
    "mpc.planner",
    "mpc.loop",
    "mpc.realtime",
    "mpc",
    "viewer.checked",
    "viewer.server",
    "viewer.camera",
    "viewer.settings",
    "viewer.recording",
    "viewer.scene_view",
    "viewer.stage",
    "viewer.panel",
    "viewer.live_data",
    "viewer.clients",
    "viewer.handles",
    "viewer.app",
    "viewer.replay",
    "viewer.overlay",
    "viewer.picture",
    "viewer.film",
    "viewer",
    "tasks.exploration",
    "tasks.motions.details",
    "tasks.motions.key_poses",
    "tasks.motions.skeleton",
    "tasks.motions.rest_pose",
    "tasks.motions.bvh_file",
    "tasks.motions.joint_names",
    "tasks.motions.bvh",
    "tasks.motions.angles",
    "tasks.motions.tracking",
    "tasks.motions.references",
    "tasks.motions.styles",
    "tasks.motions",
    "tasks.targets",
    "tasks.residuals",
    "tasks.presets",
    "tasks.standing",
    "tasks.sensors",
    "tasks.sensing",
    "tasks.strike",
    "tasks.gap",
    "tasks.command",
    "tasks.curve",
    "tasks.models",
    "tasks.pose.points",
    "tasks.pose.calibration",
    "tasks.pose.camera",
    "tasks.pose.space",
    "tasks.pose.views",
    "tasks.pose.rows",
    "tasks.pose.figure",
    "tasks.pose.joint_files",
    "tasks.pose.banded",
    "tasks.pose.image",
    "tasks.pose.prior",
    "tasks.pose.per_frame",
    "tasks.pose.lift",
    "tasks.pose.joint_motion",
    "tasks.task",
    "tasks.run",
    "tasks.session",
    "tasks.live_choices",
    "tasks.live_figures",
    "tasks.live",
    "tasks.kick",
    "tasks.episodes.people",
    "tasks.episodes.around_kick",
    "tasks.episodes.any_motion",
    "tasks.episodes.chains",
    "tasks.episodes.candidates",
    "tasks.episodes",
    "tasks.scenarios",
    "tasks.pose.point_orders",
    "tasks.pose.people",
    "tasks.pose.detectors",
    "tasks.pose.formats",
    "tasks.pose.triangulation",
    "tasks.pose.synchronisation",
    "tasks.pose.sources",
    "tasks.pose.safe_pickle",
    "tasks.pose.aist",
    "tasks.pose.metrics",
    "tasks.pose.synthetic_film",
    "tasks.pose.checkpoint",
    "tasks.pose.physical",
    "tasks.pose.picture",
    "tasks.pose.reconstruction",
    "tasks.pose.command",
    "tasks.pose.__main__",
    "tasks.pose",
    "tasks.refine",
    "tasks.kick_left",
    "tasks.kick_straight",
    "tasks.kick_right",
    "tasks.train",
    "tasks.adapt",
    "tasks.benchmarks.report",
    "tasks.benchmarks.kick",
    "tasks.benchmarks.estimation",
    "tasks.benchmarks.realtime",
    "tasks.benchmarks.gap",
    "tasks.benchmarks.model",
    "tasks.benchmarks.reference",
    "tasks.benchmarks.gpu_engines",
    "tasks.benchmarks.engines",
    "tasks.benchmarks.replays",
    "tasks.benchmarks.speed",
    "tasks.benchmarks.compilation",
    "tasks.benchmarks.content",
    "tasks.benchmarks.tradeoff",
    "tasks.benchmarks.optimizers",
    "tasks.benchmarks.promises",
    "tasks.benchmarks.step_errors",
    "tasks.benchmarks.wild_states",
    "tasks.benchmarks.stress",
    "tasks.benchmarks.random_scenes",
    "tasks.benchmarks.gradients",
    "tasks.benchmarks.laws",
    "tasks.benchmarks.damaged_files",
    "tasks.benchmarks.kick_plans",
    "tasks.benchmarks.stability",
    "tasks.benchmarks.page",
    "tasks.benchmarks.pose",
    "tasks.benchmarks.__main__",
    "tasks.benchmarks",
    "tasks.experiments.changes",
    "tasks.experiments.lists",
    "tasks.experiments.tables",
    "tasks.experiments.tracked",
    "tasks.experiments.speed",
    "tasks.experiments.runner",
    "tasks.experiments.__main__",
    "tasks.experiments",
    "tasks",
]
PACKAGES = ("larp_model", "mpc", "viewer", "tasks")
FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
TESTS = sorted((ROOT / "tests").glob("*.py"))
EXECUTING_LOADERS = {"cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"}


def module_name(path: Path) -> str:
    """Dotted name of a file of the project; a package's `__init__.py` has the name of the package."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports(tree: ast.AST, package: str) -> Iterator[tuple[int, str]]:
    """Line and absolute name of everything imported anywhere in a file of `package`.

    `from a import b` yields a.b where that is a module of this project, and a where b is a name in a.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            source = ".".join([*parents, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                yield node.lineno, inner if inner in ORDER else source


def effects(statements: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements of a module's top level that do more than import, define and name things."""
    for statement in statements:
        match statement:
            case ast.Import() | ast.ImportFrom() | ast.Expr(ast.Constant()):
                pass
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                pass
            case ast.Assign(targets=[ast.Name() | ast.Tuple()]) | ast.AnnAssign(target=ast.Name()):
                pass
            case ast.If(test=ast.Compare(left=ast.Name("__name__"))):
                pass
            case ast.If():
                yield from effects([*statement.body, *statement.orelse])
            case ast.Try():
                handlers = [inner for handler in statement.handlers for inner in handler.body]
                yield from effects([*statement.body, *handlers, *statement.orelse, *statement.finalbody])
            case _:
                yield statement


def executing_loads(tree: ast.AST) -> Iterator[int]:
    """Lines that could run code found in a data file: pickle and its kin, or `numpy.load` allowed to.

    Writing a pickle runs nothing.
    """
    writes = [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        and node.module == "pickle"
        and {each.name for each in node.names} == {"dumps"}
    ]
    for line, name in imports(tree, ""):
        if name.split(".")[0] in EXECUTING_LOADERS and line not in writes:
            yield line
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            allowed = [word.value for word in node.keywords if word.arg == "allow_pickle"]
            if ast.unparse(node.func) in ("np.load", "numpy.load"):
                allowed += node.args[2:3]
            if any(not (isinstance(value, ast.Constant) and value.value is False) for value in allowed):
                yield node.lineno


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@pytest.mark.parametrize("path", FILES, ids=module_name)
def test_imports_point_upwards(path: Path) -> None:
    name = module_name(path)
    assert name in ORDER, f"list {name} in ORDER in tests/{Path(__file__).name}, below all that it imports"
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    allowed = ORDER[: ORDER.index(name)]
    wrong = [
        f"line {line} imports {imported}"
        for line, imported in dict.fromkeys(imports(parse(path), package))
        if imported.split(".")[0] in PACKAGES and imported not in allowed
    ]
    assert not wrong, f"{name} may import only from modules listed before it in ORDER:\n" + "\n".join(wrong)


@pytest.mark.parametrize("path", FILES, ids=module_name)
def test_importing_does_nothing(path: Path) -> None:
    found = [f"line {statement.lineno}: {ast.unparse(statement)}" for statement in effects(parse(path).body)]
    assert not found, f"{module_name(path)} acts when imported:\n" + "\n".join(found)


def test_importing_everything_prints_nothing() -> None:
    said = subprocess.run(
        [sys.executable, "-c", "; ".join(f"import {name}" for name in ORDER)],
        cwd=ROOT, check=True, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert said.stdout == ""


def test_a_task_is_imported_without_what_draws_it() -> None:
    program = "import sys, tasks.kick; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, text=True, stdout=subprocess.PIPE)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert "mujoco" in loaded and not loaded & {"viewer", "viser", "matplotlib", "PIL"}


@pytest.mark.parametrize("path", FILES + TESTS, ids=module_name)
def test_data_is_never_executed(path: Path) -> None:
    lines = list(executing_loads(parse(path)))
    assert not lines, f"{module_name(path)} may run code from a data file at lines {lines}"


@pytest.mark.parametrize(
    ("source", "package", "expected"),
    [
        ("import mpc.cost", "tasks", "mpc.cost"),
        ("def late():\n    from mpc import cost", "tasks", "mpc.cost"),
        ("from mpc import CostTerm", "tasks", "mpc"),
        ("from mpc.cost import CostTerm", "tasks", "mpc.cost"),
        ("from . import spline", "mpc", "mpc.spline"),
        ("from .spline import shift", "mpc", "mpc.spline"),
        ("from ..scene import Scene", "larp_model.engines", "larp_model.scene"),
    ],
)
def test_imports_are_found(source: str, package: str, expected: str) -> None:
    assert [name for _, name in imports(ast.parse(source), package)] == [expected]


@pytest.mark.parametrize(
    "source",
    [
        "jax.config.update('jax_enable_x64', True)",
        "os.environ['XLA_FLAGS'] = ''",
        "if flag:\n    print('hello')",
        "try:\n    import warp\nexcept ImportError:\n    print('no warp')",
        "for name in names:\n    register(name)",
    ],
)
def test_effects_are_found(source: str) -> None:
    assert list(effects(ast.parse(source).body))


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "from pickle import dumps, loads",
        "np.load(file, allow_pickle=True)",
        "np.load(file, None, flag)",
    ],
)
def test_executing_loads_are_found(source: str) -> None:
    assert list(executing_loads(ast.parse(source)))


def test_writing_a_pickle_is_no_executing_load() -> None:
    assert not list(executing_loads(ast.parse("from pickle import dumps")))


def documented() -> Iterator[ast.ClassDef | ast.FunctionDef]:
    """Classes and functions of the packages."""
    for room in ("larp_model", "mpc", "viewer", "tasks"):
        for file in (ROOT / room).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.ClassDef | ast.FunctionDef):
                    yield node


def test_no_class_name_is_used_twice() -> None:
    names = [node.name for node in documented() if isinstance(node, ast.ClassDef)]
    assert sorted(set(names)) == sorted(names)


def test_no_docstring_begins_with_a_question_word() -> None:
    words = ("What", "How", "Whether", "Which", "Where", "When", "Why", "Who", "Of")
    first = [(node.name, (ast.get_docstring(node) or "-").split()[0]) for node in documented()]
    assert not [name for name, word in first if word in words]
    # Those of modules and of type aliases as well.
    texts = [
        node.value.value
        for room in ("larp_model", "mpc", "viewer", "tasks")
        for file in (ROOT / room).rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    assert not [text for text in texts if text.split()[0] in words]
