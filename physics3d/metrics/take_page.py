"""The page of one take: what was foretold of it beside what came.

<take>.md                     the table of its predictions, and the pictures below
<take>.mp4                    left what came, right what was foretold, from the first frame that was not seen on
previews/<take>_frames.png    what came, what was foretold, their difference (white: none), evenly spaced in time
previews/<take>_slices.png    a row and a column of pixels against time: what was seen, and after a line what comes
previews/<take>_curves.png    PSNR and SSIM of every frame and every prediction
previews/<take>_length.png    PSNR against how much of the clip was seen, where less of it was looked at too
"""

from urllib.parse import quote

import torch
from jaxtyping import UInt8
from torch import Tensor

from physics3d.log import Log
from physics3d.metrics.against import Lines
from physics3d.metrics.pictures import against_length, busiest, curves, slices
from physics3d.metrics.scores import markdown_table
from physics3d.pictures import contact_sheet, difference, evenly, titled
from physics3d.video import write_mp4

PICTURES = {  # what previews of a take are called after its name -> what they show
    "frames": "what came, what was foretold, their difference (white where there is none)",
    "slices": "one line of pixels against time; from the line on it was not seen",
    "curves": "every frame that was foretold",
    "length": "the same frames, foretold by less of the clip",
}
SHOWN = 6  # frames


def take_page(
    name: str,
    recorded: UInt8[Tensor, "t h w 3"],
    fps: float,
    clips: dict[str, UInt8[Tensor, "n h w 3"]],
    scores: dict[str, dict[str, float | None]],
    lines: dict[str, Lines],
    *,
    by_length: dict[str, dict[float, float]],
    seen: int,
    said: list[str],
    best: str,
    bar: str,
    log: Log,
) -> None:
    """Writes the files above, if the log keeps files. `clips`: predictions of the frames from `seen` on, by name;
    `best`: the one that is shown; `bar`: the one that it is measured against; `scores`: name -> measure -> value;
    `lines`: of every frame; `by_length`: PSNR [dB] by prediction and the seconds that were seen; none where no less was
    looked at; `said`: sentences about the take."""
    if log.folder is None:
        return
    past, future = recorded[:seen], recorded[seen:]
    write_mp4(log.path(f"{name}.mp4"), torch.cat([titled(future, "recorded"), titled(clips[best], best)], 2), fps)
    came, told = evenly(future, SHOWN), evenly(clips[best], SHOWN)
    named = {"recorded": came, best: told, "difference": difference(came, told)}
    strips = [titled(few, title) for title, few in named.items()]
    log.image(f"{name}_frames", contact_sheet(torch.cat(strips, 1), columns=SHOWN, count=SHOWN))
    whole = {"recorded": recorded} | {key: torch.cat([past, clips[key]]) for key in (best, bar)}
    log.image(f"{name}_slices", slices(list(whole), list(whole.values()), *busiest(recorded), mark=seen))
    log.image(f"{name}_curves", curves(lines, fps, first=seen))
    if by_length:
        log.image(f"{name}_length", against_length(by_length))
    text = [f"# {name}", "", f"{seen} of {len(recorded)} frames at {fps:g} fps were seen; what follows was foretold."]
    text += ["", *(f"- {sentence}" for sentence in said), "", markdown_table(scores), ""]
    text += [f"Film: [left what came, right what was foretold]({quote(name)}.mp4)"]
    for key, what in PICTURES.items():
        if key == "length" and not by_length:
            continue
        text += ["", f"{what[0].upper()}{what[1:]}:", "", f"![{key}](previews/{quote(name)}_{key}.png)"]
    log.path(f"{name}.md").write_text("\n".join(text) + "\n")
