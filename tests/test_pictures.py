"""Videos that stand beside each other say which they are."""

import pytest
import torch

from physics3d.pictures import titled


@pytest.mark.parametrize("width", [8, 96, 400])
def test_a_title_stands_above_the_frames_and_changes_none_of_them(width):
    frames = torch.randint(0, 256, (3, 20, width, 3), dtype=torch.uint8)
    shown = {title: titled(frames, title) for title in ("recorded", "learned", "")}
    strips = {title: picture[:, :-20] for title, picture in shown.items()}
    for picture in shown.values():
        assert picture.dtype == torch.uint8 and (picture[:, -20:] == frames).all()
    assert (strips[""] == 255).all() and all((s == s[:1]).all() for s in strips.values())
    assert (strips["recorded"] < 100).any() and (strips["recorded"] != strips["learned"]).any()
