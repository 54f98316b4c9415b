"""The page: a run moving in the browser, by viser; its time, its colours, the clip beside it, and a hand that pokes.

One loop in one thread draws; what a person does arrives from others and waits in a queue. While nothing moves and
nothing is asked, nothing is sent. The page says how many frames a second were computed and handed over, and what each
took: what a browser or a slow line makes of them is not known here (viser then leaves out frames that are overtaken).
"""

import contextlib
import html
import io
import math
import queue
import time
from collections import deque
from collections.abc import Callable
from typing import Any, get_args

import numpy as np

from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.view import colors, handle
from physics3d.view.live import Live
from physics3d.view.picture import SIZE, UNITS, Kind, Moment, Pictures, Splats
from physics3d.view.run import Run

RATE = 30.0  # frames a second at most
IDLE = 0.05  # between looks at whether something is asked [s]
HANDLES = 1500  # places to take hold of, at most
WIDE = 320  # of the clip, at least [px]
TURNED = 0.03  # of its distance, from which on a moved eye has new colours
SLOW = 0.9  # of the clock: below it is said how fast time passes
AHEAD = np.array([0.0, -1.0, 0.3])  # where the eye is that no camera was
POKE = "Drag any part of the body. It is simulated as you pull; the camera turns when you drag beside it."

Save = Callable[[tuple[Impulse, ...], tuple[str, ...]], str]  # (a poke, notes) -> what to tell the person


class Page:
    """Listens from the start on; `serve` moves it. Raises OSError if the port is taken."""

    def __init__(self, run: Run, *, host: str, port: int, save: Save, log: Log):
        import viser

        self.run, self.save, self.log = run, save, log
        self.pictures = Pictures(run)
        self.live: Live | None = None
        self.mode = "run"  # or "live"
        self.time = 0.0  # of the run [s]
        self.asked: queue.SimpleQueue = queue.SimpleQueue()
        self.stale = True  # something is to be drawn although nothing moves
        camera = run.camera
        middle = run.body.position.double().mean(0).numpy()
        eye = camera.centre.numpy() if camera is not None else middle + 2 * SIZE / self.pictures.scale * AHEAD
        self.eye = eye.astype(float)
        self._drawn_from: tuple[Kind, np.ndarray] | None = None  # what the still background has the colours of
        self._grip = np.zeros(3)  # where the hand took hold [units]
        self._said = 0.0  # when the rate was said last [s]
        self._spent: deque[tuple[float, float, float, int, int]] = deque(maxlen=60)  # of frames, see `rate`
        with contextlib.redirect_stdout(io.StringIO()):  # it says addresses of its own
            self.server = viser.ViserServer(host=host, port=port, label=f"Physics3D: {run.name}", verbose=False)
        if self.server.get_port() != port:  # it takes the next one that is free
            self.server.stop()
            raise OSError(f"port {port} is taken")
        self._look_from(middle)
        self._scene()
        self._panel()
        self.server.on_client_connect(self._welcome)

    # --- what is there ----------------------------------------------------------------------------------------------

    def _look_from(self, middle: np.ndarray) -> None:
        server, camera, scale = self.server, self.run.camera, self.pictures.scale
        server.scene.set_up_direction("+z")
        color = np.clip(np.array(self.run.capture.background), 0, 1)
        server.scene.set_background_image(np.full((1, 1, 3), 255 * color + 0.5).astype(np.uint8))
        server.scene.world_axes.visible = False
        ahead = middle - self.eye
        if camera is not None:
            forward = camera.world_to_camera[2, :3].numpy()
            ahead = forward * max(float(ahead @ forward), 1e-3)
            server.initial_camera.fov = 2 * math.atan(camera.height / 2 / camera.fy)
        server.initial_camera.position = self.eye * scale
        server.initial_camera.look_at = (self.eye + ahead) * scale

    def _scene(self) -> None:
        scene, pictures, body = self.server.scene, self.pictures, self.run.body
        now = pictures.moment(0)
        kind: Kind = "picture"
        add = lambda name, s: scene.add_gaussian_splats(name, s.centers, s.covariances, s.rgbs, s.opacities)
        self._moving = add("/gaussians", pictures.gaussians(now, kind, self.eye))
        self._particles = add("/particles", pictures.particles(now, kind))
        self._particles.visible = False
        self._still = add("/still", pictures.background(kind, self.eye)) if len(pictures.still) else None
        x = body.position.double().numpy()
        outside = np.flatnonzero(~body.interior.numpy())
        self._held_by = handle.spread(x, outside if len(outside) else np.arange(len(x)), HANDLES)
        wide = min(2.5, math.sqrt(max(1.0, len(outside) / HANDLES)))
        self._handles = scene.add_batched_glb(
            "/handles",
            handle.invisible(wide * body.spacing * pictures.scale),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(self._held_by), 1)).astype(np.float32),
            batched_positions=(x[self._held_by] * pictures.scale).astype(np.float32),
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

        async def dragged(event: Any) -> None:  # asynchronous: in the order in which they happen
            start, end = np.array(event.start_position), np.array(event.end_position)
            self.asked.put(("drag", event.phase, event.instance_index, start, end))

        self._handles.on_drag(dragged)

    def _panel(self) -> None:
        gui, motion = self.server.gui, self.run.trajectory
        gui.configure_theme(show_logo=False, show_share_button=False)  # sharing would leave this machine
        gui.main_panel.dock_right()
        self._rate = gui.add_markdown("")
        with gui.add_folder("Motion"):
            self.play: Any = gui.add_checkbox("play", True)
            self._speed = gui.add_slider("speed", min=0.1, max=2.0, step=0.1, initial_value=1.0)
            length = max((len(motion.position) - 1) / motion.fps, 1e-3)
            self._clock: Any = gui.add_slider("time [s]", min=0.0, max=length, step=length / 1000, initial_value=0.0)
            home = gui.add_button("camera of the clip")
        with gui.add_folder("Colours"):
            kinds = [k for k in get_args(Kind) if k != "stress" or not self.pictures.no_stress]
            self.kind = gui.add_dropdown("coloured by", kinds, initial_value="picture")
            self._balls = gui.add_checkbox("particles", False)
            self._legend = gui.add_html("")
            if self.pictures.no_stress:
                gui.add_markdown(f"*No stress: {self.pictures.no_stress}.*")
        with gui.add_folder("Poke"):
            self._told = gui.add_markdown("*Being prepared: the body's modes of vibration are computed.*")
            self._stiffness = gui.add_slider("stiffness, times", min=0.1, max=5.0, step=0.1, initial_value=1.0)
            decay = self.run.world.damping
            self._damping = gui.add_slider(
                "damping [1/s]", min=0.0, max=max(10.0, 2 * decay), step=0.1, initial_value=decay
            )
            self._rest = gui.add_button("put to rest")
            self._back = gui.add_button("back to the run")
            self._save = gui.add_button("save the poke as a scene")
            self._saved = gui.add_markdown("")
        self._pokes = (self._stiffness, self._damping, self._rest, self._back, self._save)
        for control in self._pokes:
            control.disabled = True
        clip = self.run.clip
        self._frame_of_clip, self._clip = -1, None
        if clip is not None and self.run.take is not None:
            beside = gui.add_panel()
            with beside.add_tab("Recorded clip"):
                self._clip = gui.add_image(_enlarged(clip[0].numpy()), label=f"take {self.run.take.name}")
                gui.add_markdown("*As recorded, at the same time as the run.*")
            beside.dock_left()
            beside.set_width(WIDE + 20)

        self._clock.on_update(lambda event: self.asked.put(("time",)) if event.client is not None else None)
        for look in (self.kind, self._balls):
            look.on_update(lambda _: self.asked.put(("look",)))
        for slider in (self._stiffness, self._damping):
            slider.on_update(lambda _: self.asked.put(("material",)))
        self.play.on_update(lambda event: self.asked.put(("play",)))
        self._rest.on_click(lambda _: self.asked.put(("rest",)))
        self._back.on_click(lambda _: self.asked.put(("back",)))
        self._save.on_click(lambda _: self.asked.put(("save",)))
        home.on_click(lambda event: self._go_home(event.client))

    def _go_home(self, client: Any) -> None:
        start = self.server.initial_camera
        if client is not None:
            with client.atomic():
                client.camera.position, client.camera.look_at, client.camera.fov = (
                    start.position,
                    start.look_at,
                    start.fov,
                )

    def _welcome(self, client: Any) -> None:
        @client.camera.on_update
        def _(camera: Any) -> None:
            self.asked.put(("eye", np.array(camera.position) / self.pictures.scale))

        self.asked.put(("look",))

    def prepare(self) -> None:
        """Make the poke ready, or say in the page why it cannot be. Takes seconds, and may run beside `serve`."""
        try:
            made = Live.of(self.run.world, self.run.body, self.run.values, log=self.log)
        except ValueError as reason:
            self.asked.put(("no poke", str(reason)))
            return
        self.asked.put(("poke", made))

    # --- what happens -----------------------------------------------------------------------------------------------

    def serve(self, seconds: float = math.inf) -> None:
        """Draw until interrupted, or for so long."""
        begun = last = time.perf_counter()
        while (now := time.perf_counter()) - begun < seconds:
            drawn = self.turn(now - last)
            last = now
            rest = (1 / RATE if drawn else IDLE) - (time.perf_counter() - now)
            if rest > 0:
                time.sleep(rest)

    def turn(self, elapsed: float) -> bool:
        """Do what was asked, and draw what `elapsed` [s] of the clock make of it; whether anything was drawn."""
        while not self.asked.empty():
            self._obey(*self.asked.get())
        if not self.server.get_clients():
            return False
        begun = time.perf_counter()
        moved = self._move(elapsed)
        if not (moved or self.stale):
            self._say_rate(False)
            return False
        self.stale = False
        computed = time.perf_counter()
        count, size = self._draw()
        self._spent.append((begun, computed - begun, time.perf_counter() - computed, count, size))
        self._say_rate(moved)
        return True

    def _move(self, elapsed: float) -> bool:
        if self.mode == "live" and self.live is not None:
            if not self.play.value and self.live.hold is None:
                return False
            return self.live.advance(elapsed * self._speed.value) > 0
        if not self.play.value:
            return False
        motion = self.run.trajectory
        self.time = (self.time + elapsed * self._speed.value) % (len(motion.position) / motion.fps)
        return True

    def moment(self) -> Moment:
        """What is to be seen now."""
        motion = self.run.trajectory
        if self.mode == "live" and self.live is not None:
            x, F, v = self.live.particles()
            speed = np.linalg.norm(v.numpy(), axis=1)
            return Moment(position=x, deformation=F, speed=speed, stress=self.live.stress(F))
        return self.pictures.moment(min(int(self.time * motion.fps + 1e-6), len(motion.position) - 1))

    def _draw(self) -> tuple[int, int]:
        """Send the present moment: so many splats that move, so many bytes."""
        now, kind, scale = self.moment(), self.kind.value, self.pictures.scale
        eye = self.eye
        with self.server.atomic():
            shown = self.pictures.particles(now, kind) if self._balls.value else self.pictures.gaussians(now, kind, eye)
            node = self._particles if self._balls.value else self._moving
            _send(node, shown)
            self._moving.visible, self._particles.visible = not self._balls.value, self._balls.value
            self._background(kind)
            at = now.position.numpy()[self._held_by] * scale
            self._handles.batched_positions = at.astype(np.float32)
            self._follow_clip()
            self._clock.value = min(self.time, self._clock.max) if self.mode == "run" else self._clock.value
            self._legend.content = self._legend_of(kind)
            if self.mode == "live":
                self._told.content = self._state()
        return len(shown.centers), 32 * len(shown.centers) + 12 * len(at)

    def _background(self, kind: Kind) -> None:
        if self._still is None:
            return
        if self._drawn_from is not None and self._drawn_from[0] == kind:
            before = self._drawn_from[1]
            middle = self.run.body.position.double().mean(0).numpy()
            near = np.linalg.norm(self.eye - before) < TURNED * np.linalg.norm(before - middle)
            if near or kind != "picture" or self.pictures.still.sh.shape[1] == 1:
                return
        self._drawn_from = kind, self.eye
        _send(self._still, self.pictures.background(kind, self.eye))

    def _follow_clip(self) -> None:
        clip, take = self.run.clip, self.run.take
        if self._clip is None or clip is None or take is None or self.mode == "live":
            return
        frame = min(int(self.time * take.fps + 1e-6), len(clip) - 1)
        if frame != self._frame_of_clip:
            self._frame_of_clip, self._clip.image = frame, _enlarged(clip[frame].numpy())

    def _obey(self, what: str, *told: Any) -> None:
        live = self.live
        if what == "eye":
            self.eye = told[0]
            self.stale |= self.kind.value == "picture" and self.run.gaussians.sh.shape[1] > 1
            return
        self.stale = True
        if what == "time":
            self.mode, self.time, self.play.value = "run", float(self._clock.value), False
        elif what == "poke":
            self.live = told[0]
            self._told.content = self._invitation()
            for control in self._pokes:
                control.disabled = False
        elif what == "no poke":
            self._told.content = f"*No poke here: {told[0]}.*"
        elif live is None:
            return  # what follows is about the poke
        elif what == "drag":
            self._drag(live, *told)
        elif what == "material":
            live.change(stiffness=self._stiffness.value, damping=self._damping.value)
        elif what == "rest":
            live.rest()
            self.mode = "live"
        elif what == "back":
            self.mode, self.play.value, self._told.content = "run", True, self._invitation()
        elif what == "save":
            self._keep(live)

    def _drag(self, live: Live, phase: str, which: int | None, start: np.ndarray, end: np.ndarray) -> None:
        if phase == "start" and which is not None:
            if self.mode == "run":
                live.rest()
                self.mode = "live"
            self.play.value = True
            self._grip = start
            live.grab(int(self._held_by[which]))
        if live.hold is not None and phase != "end":
            live.pull((end - self._grip) / self.pictures.scale)
        if phase == "end":
            live.let_go()

    def _keep(self, live: Live) -> None:
        notes = live.mover.notes
        if (live.stiffness, live.damping) != (1.0, self.run.world.damping):
            notes += (f"poked at {live.stiffness:g} times the stiffness, and with world.damping={live.damping:g}",)
        if live.record is not None and live.record.begin > 0:
            notes += (f"poked {live.record.begin:.2g} s after the body was at rest; here it is at the start",)
        try:
            impulses = live.record.impulses() if live.record is not None else ()
            if not impulses:
                raise ValueError("there is no poke to save yet; drag the body first")
            self._saved.content = self.save(impulses, notes)
        except (ValueError, OSError) as error:
            self._saved.content = f"*Not saved: {error}.*"

    def _state(self) -> str:
        live = self.live
        assert live is not None
        force = float(np.linalg.norm(live.force))
        again = "Let go; " + POKE[0].lower() + POKE[1:]
        lines = [f"Pulled with **{force:.2g} N**." if live.hold is not None else again]
        lines += [f"*{live.trouble}.*"] if live.trouble else []
        lines += [live.mover.how]
        lines += [f"Time passes at **{live.pace:.2f}** of the clock."] if live.pace < SLOW else []
        return "\n\n".join(lines)

    def _invitation(self) -> str:
        """What to do, before anybody has."""
        return POKE if self.live is None else f"{POKE}\n\n{self.live.mover.how}"

    def _legend_of(self, kind: Kind) -> str:
        style = 'style="padding:0 1em;font-size:85%"'
        if kind == "picture":
            return ""
        if kind == "part":
            names = self.run.body.parts or ("body",)
            table = colors.of_parts(np.arange(len(names)))
            marks = [f'<span style="color:{_css(c)}">&#9632;</span> {html.escape(n)}' for n, c in zip(names, table)]
            return f"<div {style}>{' &nbsp; '.join(marks)}</div>"
        low, high = self.pictures.ends[kind]
        if low == high:
            return f"<div {style}>{low:.3g} {UNITS[kind]} everywhere</div>"
        stops = ",".join(_css(c) for c in colors.of_values(np.linspace(0, 1, 9), 0.0, 1.0))
        gradient = f'<div style="height:0.8em;background:linear-gradient(to right,{stops})"></div>'
        return f"<div {style}>{gradient}{low:.3g} to {high:.3g} {UNITS[kind]}</div>"

    def rate(self) -> tuple[float, float, float, int, int]:
        """(frames a second, [ms] of motion, of drawing, moving splats, [byte]) of the last frames without a pause."""
        spent = list(self._spent)
        if len(spent) < 2 or spent[-1][0] <= spent[0][0]:
            return 0.0, 0.0, 0.0, 0, 0
        motion, drawing = (1e3 * float(np.mean([s[k] for s in spent])) for k in (1, 2))
        return (len(spent) - 1) / (spent[-1][0] - spent[0][0]), motion, drawing, *spent[-1][3:]

    def _say_rate(self, moving: bool) -> None:
        now = time.perf_counter()
        if now - self._said < 0.5:
            return
        self._said = now
        if not moving:
            self._spent.clear()
            self._rate.content = "**still**: nothing is sent"
            return
        rate, motion, drawing, count, size = self.rate()
        self._rate.content = (
            f"**{rate:.1f} frames/s** of {count} moving splats ({size / 1e6:.2f} MB a frame): "
            f"motion {motion:.0f} ms, drawing {drawing:.0f} ms"
        )


def _send(node: Any, splats: Splats) -> None:
    node.set_gaussians(splats.centers, splats.covariances, splats.rgbs, splats.opacities)


def _enlarged(picture: np.ndarray) -> np.ndarray:
    """Whole pixels of a small picture, for a panel that does not stretch it."""
    times = max(1, round(WIDE / picture.shape[1]))
    return picture.repeat(times, 0).repeat(times, 1)


def _css(color: np.ndarray) -> str:
    return f"rgb({color[0]},{color[1]},{color[2]})"
