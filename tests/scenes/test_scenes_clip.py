"""One clip of a thing that swings, from the file to what comes next: against the motion that was drawn."""

from dataclasses import replace

import numpy as np
import pytest
from clips import FPS, decaying, encode, swinging_rod

from physics3d.learning.unknown_cause import first_take, frames_seen, swung
from physics3d.log import Log
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.scenes.clip import ClipSource
from physics3d.world import World
from stages.fill import Fill
from stages.foretell import IMAGE, SEEN, Foretell
from stages.learn import Learn

FREQUENCY, DAMPING, RADIUS = 2.0, 0.8, 7.0


def test_a_clip_alone_tells_how_the_thing_swings_next(tmp_path):
    path = tmp_path / "rod.mp4"
    encode(swinging_rod(decaying(np.arange(100) / FPS, FREQUENCY, DAMPING, 11.0), radius=RADIUS), path)
    capture = ClipSource(name="rod", path=str(path), camera_distance=0.5, box=(0.2, 0.02, 0.8, 0.98))(log=Log(None))
    capture.check()
    (take,) = capture.takes
    assert take.excitation is None and take.posed == len(take.videos[0]) // 2 - 1
    world = World(
        material=Viscoelastic(branches=1, elastic=True),
        start=dict(
            youngs_modulus=5e4,
            poissons_ratio=0.3,
            branch_shear_modulus=1e4,
            branch_bulk_modulus=2.2e4,
            shear_relaxation_time=0.3,
            bulk_relaxation_time=0.3,
        ),
        density=500.0,
        dx=0.024,
        gravity=(0.0, 0.0, 0.0),
        solver="modes",
    )
    body = Fill(spacing=0.012)(capture, capture.gaussians, None, log=Log(None))
    assert bool(body.attached.any()) and float(body.position[body.attached, 2].max()) < 0
    learn = Learn(world=world, prior=None, learn=("youngs_modulus",), zones=1)
    estimate = learn(capture, capture.gaussians, body, log=Log(tmp_path / "learn", quiet=True))
    estimate.check()
    assert "assumed: its density is 500 kg/m^3" in (tmp_path / "learn" / "log.txt").read_text()
    # a clamped rod of this length and thickness, as assumed: f = 1.875^2/(2 pi L^2) sqrt(E I/(rho A)), I/A = r^2/4
    camera = take.cameras[0]
    pixel = 0.5 / camera.fx
    held = float(body.position[body.attached, 2].max())
    length = float(body.position[:, 2].max()) - held
    E = float(estimate.parameters["youngs_modulus"])
    turn = 2 * np.pi * FREQUENCY * 0.3  # omega tau of the branch, whose modulus is 9 K mu/(3 K + mu)
    E += 9 * 2.2e4 * 1e4 / (3 * 2.2e4 + 1e4) * turn**2 / (1 + turn**2)
    f = 1.875**2 / (2 * np.pi * length**2) * np.sqrt(E * (RADIUS * pixel) ** 2 / 4 / 500.0)
    # the body, made of particles nearly as wide as the rod, is a tenth thicker than it
    assert f == pytest.approx(FREQUENCY, rel=0.15)
    scores = Foretell(world=world, zones=1)(capture, capture.gaussians, body, estimate, log=Log(None)).values
    mine, reference = scores[f"rod: {SEEN}"], scores["rod: reference"]
    still = scores["rod: last frame seen, frozen"]
    assert mine["psnr"] > still["psnr"] + 3 and mine["ssim"] > still["ssim"]
    assert mine["frequency"] == pytest.approx(FREQUENCY, rel=0.03)
    assert mine["damping"] == pytest.approx(DAMPING, rel=0.3)
    assert reference["frequency"] == pytest.approx(FREQUENCY, rel=0.01)
    assert scores[f"rod: {IMAGE}"]["psnr"] > still["psnr"]
    # two and a half and five of the ten periods that are seen tell of the same frames; a steady swing needs no more
    less = {row: cells["psnr"] for row, cells in scores.items() if row.startswith(f"rod: {SEEN}, of ")}
    assert len(less) == 2 and min(less.values()) > still["psnr"] + 3
    assert max(scores[row.replace(SEEN, IMAGE)]["psnr"] for row in less) < mine["psnr"]
    # a release that is said to be late leaves one and a half periods to be learned from
    late = replace(capture, takes=(replace(take, release=37),))
    release = first_take(swung(world, late, capture.gaussians, body, zones=1, log=Log(None)), Log(None)).release
    assert 1.5 <= (frames_seen(take) - release) * FREQUENCY / FPS < 1.6


def test_a_clip_in_which_nothing_moves_is_refused(tmp_path):
    encode(swinging_rod(np.zeros(40)), tmp_path / "still.mp4")
    source = ClipSource(name="still", path=str(tmp_path / "still.mp4"), camera_distance=0.5)
    with pytest.raises(ValueError, match="nothing moves by more than"):
        source(log=Log(None))
