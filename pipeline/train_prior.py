"""make train-prior [OUT=folder] [ARGS="steps=2000 seed=0 device=cpu"]: a small video model, from films that it makes.

    python -m pipeline.train_prior [steps=2000] [seed=0] [device=cpu|cuda] [forms=40] [films=40]

Films of the family in `physics3d/scenes/stems.py` are made first, `films` of each of `forms` forms; then the network of
`physics3d/priors/tiny_video.py` is trained on them. Both go on where they were when the same command is given again. In
OUT: films/, training.pt, and at the end samples.png, loss.png, model.safetensors and, last, config.json, which
prior=tiny_video prior.weights=OUT reads. Exit codes: 0 done, 1 it cannot be done, 2 the command line is wrong, 130
interrupted.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.__main__ import device
from pipeline.filed import one_line
from pipeline.places import folder_to_fill
from pipeline.settings import SettingsError

USAGE = 'make train-prior [OUT=<folder>] [ARGS="steps=2000 seed=0 device=cpu forms=40 films=40"]'
DEFAULTS: dict[str, Any] = {
    "steps": 2000,
    "seed": 0,
    "device": "cpu",
    "forms": 40,
    "films": 40,
}
UNSEEN_FORMS, UNSEEN_FILMS = 4, 16  # that are kept from the training
LEVELS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0)  # sigma/alpha at which the result is looked at


def main(words: list[str], environment: Mapping[str, str]) -> int:
    left = "the same command goes on from here"
    return one_line(lambda: trained(words, environment), lambda text: print(text, file=sys.stderr), left)


def trained(words: list[str], environment: Mapping[str, str]) -> None:
    """Raises SettingsError for words that mean nothing or a device that is not there, else as `train_prior`."""
    options = asked(words)
    device(options["device"])
    out = folder_to_fill(environment, "outputs/tiny_video")
    train_prior(out, **options)
    print(f"written   {out}   use it by prior=tiny_video prior.weights={out}")


def asked(words: list[str]) -> dict[str, Any]:
    """The options by name. Raises SettingsError for a word that is none of them."""
    options = dict(DEFAULTS)
    for word in words:
        name, equals, text = word.partition("=")
        if name not in options or not equals:
            raise SettingsError(f"no option {word!r}; {USAGE}")
        if isinstance(DEFAULTS[name], int):
            if not text.isdecimal() or (name != "seed" and int(text) == 0):
                raise SettingsError(f"{word}: take a whole number; {USAGE}")
            options[name] = int(text)
        else:
            options[name] = text
    return options


def train_prior(out: Path, *, steps: int, seed: int, device: str, forms: int, films: int) -> None:
    """Raises ValueError in one line for options that cannot be, or a folder of another training."""
    import torch

    from physics3d.log import Log
    from physics3d.priors.denoising import Training, train
    from physics3d.priors.space_time_transformer import Architecture
    from physics3d.priors.tiny_video import save
    from physics3d.scenes.stems import FPS, FRAMES, MODE, PIXELS, SPREAD

    training = Training(steps=steps, seed=seed, device=device)
    log = Log(out, name="train-prior")
    seen = made(out / "films", range(forms), films, seed=seed, log=log)
    unseen = made(out / "films", range(10_000, 10_000 + UNSEEN_FORMS), UNSEEN_FILMS, seed=seed, log=log)
    log.info(f"{len(seen)} films of {forms} forms, {len(unseen)} of {UNSEEN_FORMS} others kept apart")
    network, losses = train(seen, Architecture(frames=FRAMES, size=PIXELS), training, folder=out, log=log)
    network = network.cpu()
    errors = unseen_errors(network, unseen)
    log.info(
        "error where nothing was trained, in shares of the motion, by sigma/alpha: "
        + ", ".join(f"{level}: {error:.3f}" for level, error in errors.items())
    )
    loss_curve(losses).savefig(out / "loss.png", dpi=110)
    samples(network, unseen, seed).save(out / "samples.png")
    about: dict[str, object] = {
        "knows": {
            "bodies": "physics3d/scenes/stems.py",
            "youngs_modulus_median": MODE,
            "youngs_modulus_log_deviation": SPREAD,
            "fps": FPS,
        },
        "trained": {
            "steps": steps,
            "seed": seed,
            "films": len(seen),
            "forms": forms,
            "parameters": sum(p.numel() for p in network.parameters()),
            "torch": torch.__version__,
            "error_of_unseen": errors,
        },
    }
    save(network, out, about)


def made(folder: Path, numbers: range, count: int, *, seed: int, log: Any) -> Any:
    """Films [n, t, h, w, 3] uint8 of these forms; a file for each form, written whole or not at all."""
    import torch
    from safetensors.torch import load_file, save_file

    from physics3d.log import Log
    from physics3d.scenes.stems import films

    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for number in log.progress(numbers, "making films"):
        path = folder / f"{number:05d}_{count}_{seed}.safetensors"
        if not path.exists():
            pictures, modulus, frequency = films(number, count, seed=seed, log=Log(None))
            whole = (pictures.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
            tensors = {"films": whole, "youngs_modulus": modulus, "frequency": frequency}
            save_file(tensors, path.with_suffix(".new"))
            os.replace(path.with_suffix(".new"), path)
        found.append(load_file(path)["films"])
    return torch.cat(found)


def unseen_errors(network: Any, films: Any) -> dict[str, float]:
    """Mean |x0_hat - z0|^2 over mean |z0 - still|^2 at each level, the same noise at all."""
    import torch

    from physics3d.priors.denoising import codes, denoising_error, motion

    z0 = codes(films)
    noise = torch.randn(z0.shape, generator=torch.Generator().manual_seed(0))
    scale, found = motion(films), {}
    with torch.no_grad():
        for level in LEVELS:
            ratio = torch.full((len(z0),), level)
            found[f"{level:g}"] = float(denoising_error(network, z0, ratio, noise).mean()) / scale
    return found


def loss_curve(losses: list[float]) -> Any:
    """The loss of every step, and its mean over fifty."""
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axis = figure.add_subplot()
    axis.plot(losses, lw=0.5, color="0.7", label="each step")
    width = min(50, len(losses))
    axis.plot(
        np.arange(width - 1, len(losses)),
        np.convolve(losses, np.ones(width) / width, "valid"),
        label=f"mean of {width}",
    )
    axis.set(xlabel="step", ylabel="weighted error / motion", yscale="log")
    axis.legend(frameon=False)
    return figure


def samples(network: Any, films: Any, seed: int) -> Any:
    """Of four films that were kept apart: the film, and below it two that the model draws from its first frame."""
    import numpy as np
    import torch
    from PIL import Image

    from physics3d.priors.denoising import codes, draw

    chosen = codes(films[:: len(films) // 4][:4])
    generator = torch.Generator().manual_seed(seed)
    drawn = [draw(network, chosen[:, 0], ratio=(1.0, 60.0), steps=30, generator=generator) for _ in range(2)]
    rows = []
    for i in range(4):
        for clip in (chosen[i], drawn[0][i], drawn[1][i]):
            frames = ((clip + 1) / 2).clamp(0, 1).permute(0, 2, 3, 1).numpy()
            rows.append(np.concatenate(list(frames), 1))
        rows.append(np.zeros((2, rows[-1].shape[1], 3)))
    sheet = Image.fromarray((np.concatenate(rows[:-1]) * 255 + 0.5).astype(np.uint8))
    return sheet.resize((2 * sheet.width, 2 * sheet.height), Image.Resampling.NEAREST)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ))
