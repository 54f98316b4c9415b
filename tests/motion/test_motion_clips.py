"""Clips as people have them, written by ffmpeg, read and judged; every fault of a clip is one line."""

import dataclasses
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from clips import FPS, decaying, encode, swaying

from physics3d.log import Log
from physics3d.motion.clip import read_clip
from physics3d.motion.usable import check_clip
from physics3d.scenes.clips import FRAMES, clip_files, filmed_takes
from physics3d.video import ffmpeg

SECONDS = 2.0
SWAY = decaying(np.arange(int(SECONDS * FPS)) / FPS)


@pytest.fixture(scope="module")
def sway():
    return swaying(SWAY)


@pytest.mark.parametrize(
    "words", [("-c:v", "libx264", "-crf", "8"), ("-c:v", "libx265", "-crf", "8")], ids=["h264", "hevc"]
)
@pytest.mark.parametrize("fps", [24.0, 29.97, 60.0])
def test_frames_and_rate_come_back(tmp_path, sway, words, fps):
    path = tmp_path / "clip.mov"
    encode(sway[:20], path, *words, "-pix_fmt", "yuv444p", fps=fps)
    clip = read_clip(path)
    assert clip.frames.shape == sway[:20].shape and clip.size == (128, 96) and clip.notes == ()
    assert clip.fps == pytest.approx(fps, rel=1e-3)  # containers count in thousandths of a second or finer
    assert (clip.frames.float() - sway[:20].float()).abs().mean() < 3  # grey levels, of a codec at high quality


def test_a_clip_on_its_side_is_turned_upright_and_that_is_said(tmp_path, sway):
    encode(sway[:12], tmp_path / "flat.mp4")
    words = [ffmpeg(), "-v", "error", "-display_rotation", "90", "-i", str(tmp_path / "flat.mp4"), "-c", "copy"]
    subprocess.run([*words, str(tmp_path / "phone.mp4")], check=True)
    clip = read_clip(tmp_path / "phone.mp4")
    upright = torch.rot90(sway[:12], 1, (1, 2))  # by 90 degrees against the clock
    assert clip.frames.shape == upright.shape and clip.size == (96, 128)
    assert (clip.frames.float() - upright.float()).abs().mean() < 5
    assert "turned by" in " ".join(clip.notes)


def test_a_variable_rate_is_made_constant_and_that_is_said(tmp_path, sway):
    """Every third frame of the middle second is dropped, as phones do in the dark; times stay right."""
    encode(sway, tmp_path / "even.mp4")
    chosen = "select='not(between(n,15,45)*not(mod(n,3)))'"
    words = [ffmpeg(), "-v", "error", "-i", str(tmp_path / "even.mp4"), "-vf", chosen, "-fps_mode", "passthrough"]
    subprocess.run([*words, "-c:v", "libx264", "-crf", "8", str(tmp_path / "uneven.mp4")], check=True)
    clip = read_clip(tmp_path / "uneven.mp4")
    assert "variable frame rate" in clip.notes[0]
    assert len(clip.frames) / clip.fps == pytest.approx(SECONDS, abs=2 / clip.fps)
    # frame i shows the instant i/fps: nearer to the true one than to those two frames of the original away
    for i in (5, len(clip.frames) // 2, len(clip.frames) - 6):
        at = round(i / clip.fps * FPS)
        distance = [(clip.frames[i].float() - sway[k].float()).abs().mean() for k in (at, at - 3, at + 3)]
        assert distance[0] < min(distance[1:])


def test_size_and_piece_are_chosen(tmp_path, sway):
    encode(sway, tmp_path / "clip.mp4")
    clip = read_clip(tmp_path / "clip.mp4", longest_side=64)
    assert clip.frames.shape == (60, 48, 64, 3) and "reduced from 128 x 96 to 64 x 48 px" in clip.notes
    piece = read_clip(tmp_path / "clip.mp4", longest_side=64, first=15, count=30)
    assert torch.equal(piece.frames, clip.frames[15:45])


def test_a_piece_is_used_as_a_player_shows_its_times(tmp_path, sway):
    encode(sway, tmp_path / "clip.mp4")
    whole = read_clip(tmp_path / "clip.mp4")
    for fps in (None, 240):  # slow motion is played slowly
        used = read_clip(tmp_path / "clip.mp4", fps=fps, piece=(0.5, 1.5))
        assert torch.equal(used.frames, whole.frames[15:45])
        two = read_clip(tmp_path / "clip.mp4", fps=fps, piece=(0.5, 1.5), first=7, count=2)
        assert torch.equal(two.frames, used.frames[7:9])
    with pytest.raises(ValueError, match=r"0 frames from 2\.5 to 3 s; it lasts 1\.97 s"):
        read_clip(tmp_path / "clip.mp4", piece=(2.5, 3.0))
    black = torch.cat([0 * sway[:15], sway])  # begins in black: a cut, unless the piece leaves it out
    encode(black, tmp_path / "black.mp4")
    with pytest.raises(ValueError, match=r"a cut before frame 15 .*scene\.source\.pieces"):
        filmed_takes(tmp_path / "black.mp4", log=Log(None))
    (take,) = filmed_takes(tmp_path / "black.mp4", pieces={"black": (0.5, 9.0)}, log=Log(None))
    assert len(take.video) == len(sway)
    with pytest.raises(ValueError, match=r"source\.pieces names poke, which is none of the clips; take black"):
        filmed_takes(tmp_path / "black.mp4", pieces={"poke": (0.5, 9.0)}, log=Log(None))


def test_a_rate_that_is_given_is_that_of_the_camera(tmp_path, sway):
    """Slow motion: every frame that was filmed is in the file, at another rate than it was filmed at."""
    encode(sway, tmp_path / "slow.mp4")
    told, given = read_clip(tmp_path / "slow.mp4"), read_clip(tmp_path / "slow.mp4", fps=240)
    assert torch.equal(told.frames, given.frames) and given.fps == 240
    assert "its file says 30 frames per second; filmed at 240" in given.notes[0]


def test_of_a_fast_camera_fewer_frames_are_used_and_of_a_long_clip_the_first(tmp_path, sway):
    for name, fps in (("fast.mp4", 120.0), ("long.mp4", 30.0)):
        encode(sway, tmp_path / name, fps=fps)
        whole, used = read_clip(tmp_path / name), read_clip(tmp_path / name, most=12)
        every = 4 if fps > 30 else 1  # 12 of 60 would be every fifth: 24 in a second, less than 25
        assert torch.equal(used.frames, whole.frames[::every][:12]) and used.fps == fps / every
        said = " ".join(used.notes)
        assert ("30 of its 120 frames per second are used" in said) == (every > 1) and "s are used, of" in said
        piece = read_clip(tmp_path / name, most=12, first=10, count=5)
        assert torch.equal(piece.frames, used.frames[10:])
    assert read_clip(tmp_path / "long.mp4", most=60).notes == ()


def test_pixels_are_square(tmp_path, sway):
    encode(sway[:12], tmp_path / "wide.mp4", "-vf", "scale=64:96,setsar=2", "-c:v", "libx264", "-crf", "8")
    clip = read_clip(tmp_path / "wide.mp4")
    assert clip.frames.shape == (12, 96, 128, 3) and clip.size == (128, 96)
    assert clip.notes == ("its pixels are 2:1, made square",)


def test_a_frame_is_of_one_instant(tmp_path):
    """Interlaced: the odd lines of every frame are those of the next instant."""
    moved = swaying(decaying(np.arange(40) / (2 * FPS), frequency=4.0, amplitude=12.0))
    combed = moved[::2].clone()
    combed[:, 1::2] = moved[1::2, 1::2]
    words = ("-vf", "setfield=tff", "-c:v", "libx264", "-crf", "8", "-flags", "+ilme+ildct")
    encode(combed, tmp_path / "combed.mp4", *words)
    clip = read_clip(tmp_path / "combed.mp4")
    away = lambda video: (video.float() - moved[::2].float()).square().mean()
    assert len(clip.frames) == len(combed) and "interlaced" in clip.notes[0]
    assert away(clip.frames) < 0.3 * away(combed)


def test_transparency_is_left_out_and_that_is_said(tmp_path, sway):
    encode(sway[:12], tmp_path / "cut_out.mov", "-vf", "format=argb", "-c:v", "qtrle")
    clip = read_clip(tmp_path / "cut_out.mov")
    assert torch.equal(clip.frames, sway[:12]) and "transparency" in clip.notes[0]


def test_what_is_no_clip_is_refused_in_one_line(tmp_path, sway):
    (tmp_path / "text.mp4").write_text("not a video")
    sound = ["-f", "lavfi", "-i", "sine=duration=0.2", str(tmp_path / "sound.m4a")]
    subprocess.run([ffmpeg(), "-v", "error", *sound], check=True)
    encode(sway[:1], tmp_path / "one.mp4")
    encode(sway[:12], tmp_path / "bare.h264", "-c:v", "libx264", "-f", "h264")
    encode(sway[:12], tmp_path / "bare.mjpeg", "-c:v", "mjpeg", "-f", "mjpeg")
    for name, message in (
        ("none.mp4", "no clip at"),
        ("text.mp4", "cannot read the clip text.mp4"),
        ("sound.m4a", "no video in it"),
        ("one.mp4", "1 frame"),
        ("bare.h264", "rate is unknown"),
        ("bare.mjpeg", "rate is unknown"),
    ):
        with pytest.raises(ValueError, match=message) as error:
            read_clip(tmp_path / name)
        assert "\n" not in str(error.value)
    for name in ("bare.h264", "bare.mjpeg"):  # whatever rate ffmpeg would think of
        clip = read_clip(tmp_path / name, fps=50)
        assert len(clip.frames) == 12 and clip.fps == 50


@pytest.mark.parametrize("name", ["a:b.mp4", "-y.mp4", "p%04d (1).mp4", "concat:x|y.mp4"])
def test_no_name_is_a_protocol_or_an_option_of_ffmpeg(tmp_path, sway, name, monkeypatch):
    encode(sway[:12], tmp_path / "clip.mp4")
    (tmp_path / "clip.mp4").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert len(read_clip(Path(name)).frames) == 12


def test_what_was_cut_off_while_it_was_copied_is_refused(tmp_path, sway):
    encode(sway, tmp_path / "whole.mp4", "-c:v", "libx264", "-movflags", "+faststart")
    whole = (tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "half.mp4").write_bytes(whole[: 6 * len(whole) // 10])
    with pytest.raises(ValueError, match=r"half\.mp4 is damaged after \d+ frames .*; copy it again") as error:
        read_clip(tmp_path / "half.mp4")
    assert "\n" not in str(error.value)


def test_what_is_shorter_than_its_file_says_is_read_and_that_is_said(tmp_path, sway):
    encode(sway, tmp_path / "whole.mkv", "-c:v", "libx264")
    whole = (tmp_path / "whole.mkv").read_bytes()
    (tmp_path / "half.mkv").write_bytes(whole[: len(whole) // 2])
    clip = read_clip(tmp_path / "half.mkv")
    assert 8 < len(clip.frames) < 50 and "it may be cut short" in clip.notes[0] and "2.00 s" in clip.notes[0]
    assert read_clip(tmp_path / "whole.mkv").notes == ()


def test_without_ffmpeg_the_remedy_is_named(tmp_path, sway, monkeypatch):
    encode(sway[:12], tmp_path / "clip.mp4")
    import imageio_ffmpeg

    def missing():
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    with pytest.raises(RuntimeError, match="make setup"):
        read_clip(tmp_path / "clip.mp4")


def judged(tmp_path, frames, **more):
    encode(frames, tmp_path / "clip.mp4")
    return check_clip(read_clip(tmp_path / "clip.mp4"), **more)


def test_a_good_clip_says_what_moves_how_and_from_when(tmp_path, sway):
    found = judged(tmp_path, sway, box=(0.1, 0.1, 0.9, 0.9))
    main = found.decay.main()
    assert found.decay.frequency[main] == pytest.approx(2.0, rel=0.03) and found.release <= 6
    assert found.where[48, 64] and not found.where[:4].any()
    assert abs(SWAY[found.rest]) < 1.0  # of 6 px
    assert found.largest == pytest.approx(np.abs(SWAY - SWAY[found.rest]).max(), rel=0.15)


FAULTS = {
    "nothing moves": (lambda: swaying(np.zeros(30), noise=1.0), {}),
    "the camera moves": (lambda: swaying(0.5 * SWAY, camera=1.0), {}),
    "there is a cut before frame 30": (lambda: torch.cat([swaying(SWAY[:30]), 255 - swaying(SWAY[30:])]), {}),
    "leaves the picture": (lambda: swaying(10 * SWAY), {}),
    "shorter than half a period": (lambda: swaying(decaying(np.arange(20) / FPS, frequency=0.25, phase=-1.2)), {}),
    "the mask is empty": (lambda: swaying(SWAY), {"box": (0.0, 0.0, 0.1, 0.1)}),
    "box is": (lambda: swaying(SWAY), {"box": (0.5, 0.0, 0.1, 0.1)}),
    "at least 8": (lambda: swaying(SWAY[:5]), {}),
}


@pytest.mark.parametrize("message", FAULTS)
def test_every_fault_is_found_and_named(tmp_path, message):
    make, more = FAULTS[message]
    with pytest.raises(ValueError, match=message) as error:
        judged(tmp_path, make(), **more)
    assert "\n" not in str(error.value)


T = np.arange(len(SWAY)) / FPS
BACK = swaying(SWAY)
KINDS = {  # further instances of each fault
    "pans slowly": ("the camera moves", lambda: warped(shift=1.5 * T)),
    "zooms by 4 %": ("the camera moves", lambda: warped(zoom=1 + 0.02 * T)),
    "is held by hand": ("the camera moves", lambda: warped(shift=2 * np.sin(2 * np.pi * 0.7 * T) + np.sin(11 * T))),
    "cut near its end": ("there is a cut before frame 57", lambda: torch.cat([BACK[:57], 255 - BACK[57:]])),
    "ends in black": ("there is a cut before frame 55", lambda: torch.cat([BACK[:55], 0 * BACK[55:]])),
    "cut within a scene": ("a cut before frame 30", lambda: torch.cat([BACK[:30], warped(shift=30 + 0 * T)[30:]])),
    "leaves and comes back": ("leaves the picture", lambda: swaying(SWAY - 40 * np.exp(-(((T - 1) / 0.3) ** 2)))),
    "flickers, nothing moves": ("nothing moves", lambda: lit(swaying(0 * SWAY), 1 + 0.05 * np.cos(9 * T))),
    "drifts one way": ("shorter than half a period", lambda: swaying(6 * T)),
}


def lit(video, light):
    return (video * torch.tensor(light)[:, None, None, None]).clamp(0, 255).byte()


def warped(shift=0 * T, zoom=1 + 0 * T):
    """The swaying thing by a camera that moves: every frame drawn aside by `shift` [px] and larger by `zoom`."""
    import cv2

    h, w = BACK.shape[1:3]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    at = lambda s, z: (((x - w / 2) / z + w / 2 - s).astype(np.float32), ((y - h / 2) / z + h / 2).astype(np.float32))
    drawn = [
        cv2.remap(frame, *at(s, z), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        for frame, s, z in zip(BACK.numpy(), shift, zoom)
    ]
    return torch.from_numpy(np.stack(drawn))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_a_fault_is_found(tmp_path, kind):
    message, make = KINDS[kind]
    with pytest.raises(ValueError, match=message):
        judged(tmp_path, make())


def wind(rng):
    """What gusts make of a swing of 2 Hz."""
    place, speed, path = 0.0, 0.0, []
    for _ in T:
        for _ in range(10):
            speed += (-((4 * np.pi) ** 2) * place - 1.6 * speed + 1500 * rng.normal()) / (10 * FPS)
            place += speed / (10 * FPS)
        path.append(place)
    return 6 * np.array(path) / np.abs(path).max()


DRIVEN = {  # motions that are no free decay, each with what is said of it
    "a hand": (lambda rng: 5 * np.sin(9 * T + 2 * np.sin(4.1 * T)), "does not follow from its first"),
    "wind": (wind, "does not follow from its first"),
    "another push": (lambda rng: SWAY + np.where(T > 1.3, 5 * np.sin(14 * (T - 1.3)), 0), "does not follow"),
    "a motor": (lambda rng: 5 * np.sin(2 * np.pi * 2 * T), "hardly dies out"),
}


@pytest.mark.parametrize("cause", DRIVEN)
def test_what_is_not_left_alone_is_doubted(tmp_path, cause, rng):
    make, message = DRIVEN[cause]
    (doubt,) = judged(tmp_path, swaying(make(rng))).doubts
    assert message in doubt and "\n" not in doubt


def test_a_free_decay_is_not_doubted(tmp_path, sway):
    assert judged(tmp_path, sway).doubts == ()
    slow = swaying(decaying(np.arange(90) / FPS, frequency=1.0, damping=0.1, amplitude=6.0))
    assert judged(tmp_path, slow).doubts == ()


def test_light_that_changes_is_no_fault(tmp_path):
    """A lamp at 3 Hz, 5 %; a cloud, 20 % in the end."""
    for light in (1 + 0.05 * np.sin(2 * np.pi * 3 * T), 1 - 0.1 * T):
        found = judged(tmp_path, lit(BACK, light))
        assert found.decay.frequency[found.decay.main()] == pytest.approx(2.0, rel=0.03)


def test_takes_of_a_folder_are_one_to_learn_and_others_to_predict(tmp_path, sway):
    for name, frames in (("b.mp4", sway), ("a.mov", swaying(-0.7 * SWAY))):
        encode(frames, tmp_path / name)
    takes = filmed_takes(tmp_path, log=Log(None))
    assert [(t.name, t.role) for t in takes] == [("a", "learn"), ("b", "evaluate")]
    from physics3d.gaussians.cameras import Camera

    camera = Camera(width=128, height=96, fx=100, fy=100, cx=64, cy=48, world_to_camera=torch.eye(4).double())
    take = takes[0].seen_by(camera)
    assert take.excitation is None and take.release == takes[0].release and take.fps == FPS
    with pytest.raises(ValueError, match="scale it"):
        takes[0].seen_by(dataclasses.replace(camera, width=64))
    with pytest.raises(ValueError, match="no clip"):
        filmed_takes(tmp_path / "empty", log=Log(None))


def test_a_take_has_no_more_frames_than_memory_and_minutes_allow(tmp_path):
    shift = decaying(np.arange(2 * FRAMES) / 60, damping=0.4, amplitude=3.0)
    encode(swaying(shift, h=48, w=64), tmp_path / "fast.mp4", fps=60)
    (take,) = filmed_takes(tmp_path / "fast.mp4", log=Log(None))
    assert len(take.video) == FRAMES and take.fps == 30
    assert take.decay.frequency[take.decay.main()] == pytest.approx(2.0, rel=0.03)


def test_clips_of_a_folder_are_files_that_fit_and_have_names_of_their_own(tmp_path):
    for name in ("b.mp4", "a (1).mp4", "._a.mp4", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "folder.mp4").mkdir()
    assert [p.name for p in clip_files(tmp_path)] == ["a (1).mp4", "b.mp4"]
    assert [p.name for p in clip_files(tmp_path, "a (?).mp4")] == ["a (1).mp4"]
    for pattern in ("/*", "c*", "[", "../*"):
        with pytest.raises(ValueError, match="holds no clip"):
            clip_files(tmp_path, pattern)
    (tmp_path / "b.MOV").touch()
    with pytest.raises(ValueError, match=r"b\.MOV and b\.mp4, whose takes would have one name"):
        clip_files(tmp_path)


@pytest.mark.parametrize("thing", ["carnation", "telephone"])
def test_the_real_takes_are_usable(data, thing):
    path = data / thing / "videos" / "real_take3.mp4"
    if not path.is_file():
        pytest.skip(f"no {path}")
    found = check_clip(read_clip(path, longest_side=320))
    lowest, highest = {"carnation": (2.2, 3.4), "telephone": (1.0, 1.1)}[thing]  # Hz, as read off the recordings
    assert lowest < found.decay.frequency[found.decay.main()] < highest
