"""Whoever launches a kernel first, all kernels are compiled alike: a resumed run rounds as a straight one does."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted((ROOT / "physics3d").rglob("*.py"))

# does one thing after the other, and says of each what came out, bit by bit, and how kernels are compiled from then on;
# for each order a child of a process that has imported everything and started nothing
PROGRAM = """
import hashlib, json, os, sys
import torch, warp as wp
from physics3d.gaussians.cameras import look_at, Camera
from physics3d.gaussians.rasterize import rasterize
from physics3d.log import Log
from physics3d.materials.driver import uniaxial
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.mpm.rollout import rollout
from physics3d.world import World

MATERIAL, START = NeoHookean(), dict(youngs_modulus=1e4, poissons_ratio=0.3)
PARAMETERS = {name: torch.tensor(value) for name, value in START.items()}

def numbers(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))

def solver():
    world = World(material=MATERIAL, start=START, density=1000.0, dx=0.1, dt=0.001)
    position = 0.2 * numbers(20, 3)
    options = dict(velocity=numbers(20, 3), frames=2, frame_dt=0.005, threads=1, log=Log(None))
    return rollout(world, PARAMETERS, position, torch.full((20,), 1e-4), **options).position

def driver():
    return uniaxial(MATERIAL, PARAMETERS, torch.linspace(0, 1, 5), torch.linspace(1, 1.3, 5))[0]

def renderer():
    pose = look_at(torch.tensor([0.5, -2.0, 0.5]), torch.tensor([0.5, 0.5, 0.5]))
    camera = Camera(world_to_camera=pose, fx=60.0, fy=60.0, cx=20.0, cy=15.0, width=40, height=30)
    A = 0.1 * numbers(50, 3, 3)
    covariance = A @ A.mT + 1e-3 * torch.eye(3)
    picture = rasterize(numbers(50, 3), covariance, numbers(50), numbers(50, 3), camera, background=(0.0, 0.0, 0.0))
    return picture.color

for order in sys.argv[1:]:
    if os.fork():
        _, status = os.wait()
        if status:
            sys.exit(1)
        continue
    said = {}
    for name in order.split():
        found = hashlib.sha256(globals()[name]().numpy().tobytes()).hexdigest()
        said[name] = [found, wp.config.cpu_compiler_flags]
    print(json.dumps(said))
    sys.exit()
"""


def said(*orders: str) -> list[dict[str, list[str]]]:
    words = [sys.executable, "-c", PROGRAM, *orders]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def test_results_and_flags_do_not_depend_on_who_starts_first():
    solver_first, driver_first, renderer_first = said(
        "solver driver renderer", "driver renderer solver", "renderer solver driver"
    )
    assert solver_first == driver_first == renderer_first
    assert len({flags for _, flags in solver_first.values()}) == 1


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_nobody_else_sets_up_warp(path: Path):
    names = {ast.unparse(node) for node in ast.walk(tree(path)) if isinstance(node, ast.Attribute)}
    own = {name for name in names if name == "wp.init" or name.startswith("wp.config.")}
    assert not own or path.name == "warp_start.py", f"{path.name} uses {sorted(own)}; call start_warp"


def test_every_room_that_launches_kernels_starts_warp():
    called: dict[str, set[str]] = {}
    for path in FILES:
        calls = {ast.unparse(node.func) for node in ast.walk(tree(path)) if isinstance(node, ast.Call)}
        called.setdefault(path.relative_to(ROOT).parts[1], set()).update(calls)
    launching = {room for room, calls in called.items() if "wp.launch" in calls}
    assert launching >= {"mpm", "materials", "gaussians"}
    assert all("start_warp" in called[room] for room in launching)
