"""Every Warp kernel says what goes in, then what comes out, and of each argument its shape or unit.

Read from the source, so that a kernel need not be made for it: arguments under `# in`, then those under `# out`, one to
a line, each with a comment; that of an array or a real number holds a shape or a unit in brackets.
"""

import ast
import io
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def is_kernel(node: ast.AST) -> bool:
    if not isinstance(node, ast.FunctionDef):
        return False
    called = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
    return any(ast.unparse(decorator) == "wp.kernel" for decorator in called)


def kernels(source: str) -> list[ast.FunctionDef]:
    return [node for node in ast.walk(ast.parse(source)) if is_kernel(node)]


def comments(source: str) -> dict[int, tuple[str, bool]]:
    """Line -> its comment, and whether there is nothing else on it."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    found = [t for t in tokens if t.type == tokenize.COMMENT]
    return {t.start[0]: (t.string.removeprefix("#").strip(), not t.line[: t.start[1]].strip()) for t in found}


def written(kernel: ast.FunctionDef) -> set[str]:
    """Names of arrays that the kernel itself assigns to or adds to."""
    names = set()
    for node in ast.walk(kernel):
        targets = node.targets if isinstance(node, ast.Assign) else []
        targets = [node.target] if isinstance(node, ast.AugAssign) else targets
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("wp.atomic_"):
            names.add(ast.unparse(node.args[0]))
        for target in targets:
            for part in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(part, ast.Subscript):
                    names.add(ast.unparse(part.value))
    return names


def handed_on(kernel: ast.FunctionDef) -> set[str]:
    """Names that the kernel gives to functions, which may write to them."""
    calls = [node for node in ast.walk(kernel) if isinstance(node, ast.Call)]
    return {argument.id for call in calls for argument in call.args if isinstance(argument, ast.Name)}


def faults(kernel: ast.FunctionDef, source: str) -> list[str]:
    said = comments(source)
    arguments = kernel.args.args
    first, last = kernel.lineno, kernel.body[0].lineno
    heads = [(line, text) for line, (text, alone) in said.items() if first < line < last and alone]
    ins = [line for line, text in heads if text == "in"]
    outs = [line for line, text in heads if text == "out" or text.startswith("out, ")]
    if len(ins) != 1 or len(outs) != 1 or not first < ins[0] < arguments[0].lineno < outs[0] < arguments[-1].lineno:
        return ["no `# in` before the first argument and `# out` before the last ones"]
    found = []
    for argument in arguments:
        text, alone = said.get(argument.lineno, ("", True))
        integer = argument.annotation is not None and ast.unparse(argument.annotation) == "int"
        struct = argument.annotation is not None and ast.unparse(argument.annotation)[0].isupper()
        if not text or alone or sum(a.lineno == argument.lineno for a in arguments) > 1:
            found.append(f"{argument.arg} has no comment of its own")
        elif not (integer or struct) and not ("[" in text and "]" in text):
            found.append(f"{argument.arg} has neither shape nor unit in brackets")
    outputs = {argument.arg for argument in arguments if argument.lineno > outs[0]}
    inputs = {argument.arg for argument in arguments} - outputs
    found += [f"{name} is written to and no output" for name in sorted(written(kernel) & inputs)]
    found += [
        f"{name} is an output and not written to" for name in sorted(outputs - written(kernel) - handed_on(kernel))
    ]
    return found


FILES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in sorted((ROOT / "physics3d").rglob("*.py"))}
KERNELS = [
    pytest.param(kernel, source, id=f"{name}:{kernel.name}")
    for name, source in FILES.items()
    for kernel in kernels(source)
]


@pytest.mark.parametrize(("kernel", "source"), KERNELS)
def test_inputs_come_first_and_every_argument_has_shape_or_unit(kernel: ast.FunctionDef, source: str):
    assert not faults(kernel, source), f"{kernel.name}, line {kernel.lineno}: {'; '.join(faults(kernel, source))}"


def test_solver_renderer_and_driver_are_among_them():
    rooms = {name.split("/")[1] for name, source in FILES.items() if kernels(source)}
    assert rooms >= {"mpm", "gaussians", "materials"}


GOOD = """
@wp.kernel(module="unique")
def double(
    # in
    first: int,  # particle of thread 0
    x: wp.array(dtype=float),  # [p] [m]
    # out
    y: wp.array(dtype=float),  # [p] [m]
):
    y[wp.tid() + first] = 2.0 * x[wp.tid() + first]
"""


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("", ""), ""),
        (("    # in\n", ""), "no `# in`"),
        (("    # out\n", ""), "no `# in`"),
        (("    # out\n    y", "    y"), "no `# in`"),
        (("  # particle of thread 0", ""), "first has no comment"),
        (("[p] [m]\n    # out", "positions\n    # out"), "x has neither shape nor unit"),
        (("    y[wp", "    x[wp"), "x is written to and no output; y is an output and not written to"),
        (("    y[wp.tid() + first] =", "    wp.atomic_add(x, 0, 1.0)\n    y[wp.tid() + first] ="), "x is written to"),
    ],
)
def test_faults_are_found(change: tuple[str, str], says: str):
    source = GOOD.replace(*change) if change[0] else GOOD
    (kernel,) = kernels(source)
    found = "; ".join(faults(kernel, source))
    assert found.startswith(says) if says else not found
