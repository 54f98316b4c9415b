"""Particles and their material -> trajectory."""

from dataclasses import dataclass

import torch

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.impulse import Force, excited, has_force
from physics3d.checks import Device, Frames, Rate, require_fields
from physics3d.filling.body import Body
from physics3d.filling.in_world import look_ahead, say_resolution
from physics3d.log import Log
from physics3d.solver import motion_of
from physics3d.trajectory import Trajectory
from physics3d.world import Estimate, World


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Rolls the body out under the world's boundaries and what excites it here."""

    world: World
    frames: Frames  # with frame 0, the initial state
    fps: Rate  # [1/s]
    excitation: tuple[AbstractBoundary, ...] = ()
    force: Force | None = None  # takes the place of the force of every Impulse above [N]; None: none does
    device: Device = "cpu"

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "simulate")
        if self.force is not None and any(self.force.values()) and not any(map(has_force, self.excitation)):
            raise ValueError(
                f"simulate.force is {dict(self.force)}, but no impulse in simulate.excitation has a force that it "
                "could replace; take None and say there what pushes"
            )

    def __call__(self, body: Body, estimate: Estimate, *, log: Log) -> Trajectory:
        """Raises ValueError as `check`, `look_ahead` and `rollout` do."""
        self.check()
        excitation = excited(self.excitation, self.force)
        world = self.world.weighed(estimate)
        section = look_ahead(body, world, excitation, log)
        with torch.no_grad():
            part = lambda values: world.material.per_part(values, body.part, body.parts)
            motion = motion_of(
                world.starting_at(estimate.parameters),
                body.position,
                body.volume,
                excitation=(*body.held, *excitation),
                part=part,
                matter=body.matter,
                device=self.device,
                log=log,
            )
            if motion.modes is None and world.solver == "auto":  # otherwise said already
                say_resolution(section, world.dx, log)
            parameters = part(estimate.parameters)
            motion.report(parameters)
            trajectory = motion(
                parameters, velocity=estimate.velocity, frames=self.frames, frame_dt=1 / self.fps, log=log
            )
        trajectory = _on_cpu(trajectory)
        for name, curve in trajectory.health.items():
            for frame, value in enumerate(curve):
                log.metric(f"health/{name}", value, frame)
        mass = world.density * float(body.volume.sum())
        log.metric("mass", mass)
        log.metric("substeps_per_frame", trajectory.substeps)
        log.info(
            f"{len(body.position)} particles, {mass:.3g} kg, {self.frames} frames of up to "
            f"{trajectory.substeps} substeps (shortest {trajectory.substep_dt:.2e} s)"
        )
        _report(trajectory, log)
        log.image("motion", _plot(trajectory))
        return trajectory


def _on_cpu(trajectory: Trajectory) -> Trajectory:
    return Trajectory(
        rest_position=trajectory.rest_position.cpu(),
        position=trajectory.position.cpu(),
        velocity=trajectory.velocity.cpu(),
        deformation=trajectory.deformation.cpu(),
        fps=trajectory.fps,
        health=trajectory.health,
        substeps=trajectory.substeps,
        substep_dt=trajectory.substep_dt,
    )


def _report(trajectory: Trajectory, log: Log) -> None:
    """Say what looks unwell."""
    health = trajectory.health
    worst = int(max(health["inverted"]))
    if worst:
        log.warn(f"up to {worst} particles are turned inside out; take a smaller cfl, a smaller dx or a weaker force")
    moved = float((trajectory.position - trajectory.rest_position).norm(dim=2).max())
    size = float((trajectory.rest_position.amax(0) - trajectory.rest_position.amin(0)).max())
    log.metric("moved", moved)
    share = moved / max(size, 1e-12)
    of_size = f"{100 * share:.2g} % of its size" if share < 1 else f"{share:.1f} times its size"
    log.info(f"it moves by at most {1e3 * moved:.3g} mm, {of_size}")
    lonely = int(health["isolated"][0])
    if lonely:
        log.warn(f"{lonely} particles have no neighbour within a cell and move alone; fill more densely or enlarge dx")


def _plot(trajectory: Trajectory):
    """Mean displacement and that of the particle that moves most, over time, beside the energies."""
    from matplotlib.figure import Figure

    moved = trajectory.position - trajectory.rest_position
    distance = moved.norm(dim=2)
    tip = int(distance.amax(0).argmax())
    time = torch.arange(len(moved)) / trajectory.fps
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axis, name in enumerate("xyz"):
        left.plot(time, moved[:, tip, axis], color=f"C{axis}", label=f"tip, {name}")
        left.plot(time, moved[:, :, axis].mean(1), color=f"C{axis}", linestyle="--", label=f"mean, {name}")
    left.set(xlabel="time [s]", ylabel="displacement [m]")
    left.legend(fontsize="small")
    for name in ("kinetic", "elastic", "potential"):
        curve = torch.tensor(trajectory.health[f"{name}_energy"])
        right.plot(time, curve - curve[0], label=name)
    right.set(xlabel="time [s]", ylabel="energy since the start [J]")
    right.legend(fontsize="small")
    return figure
