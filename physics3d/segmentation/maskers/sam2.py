"""SAM 2: better than GrabCut where its weights are. Ravi et al. (2024), "SAM 2"."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import MultipleOf
from jaxtyping import Float

from physics3d.checks import Count, Device, Pixels, Text
from physics3d.priors.weights import hub_answers
from physics3d.segmentation.maskers.base import AbstractMasker, AbstractVideoMasker
from physics3d.segmentation.pixels import bounds, centres, eroded, thinned

SURE = 0.95  # share of a pixel above which it is the object's, and 1 - SURE below which it is not


@dataclass(frozen=True, kw_only=True)
class Sam2(AbstractMasker):
    """SAM 2's image predictor. `weights`: a .pt file, or the name of a repository of facebook/sam2* on the hub."""

    config: Text = "sam2.1/sam2.1_hiera_t"  # a .yaml below the package's `configs`
    weights: Text = "facebook/sam2.1-hiera-tiny"
    image_size: Annotated[Pixels, MultipleOf(32)] = 1024  # side of the square the network sees [px]
    most_points: Count = 8
    device: Device = "cpu"

    def files(self) -> tuple[str, ...]:
        """The weights, fetched if they are not on this machine: part of the fingerprint of the segmentation."""
        return (str(sam2_weights(self.weights)),)

    def __call__(self, image, *, box, positive, negative):
        return self._predict(image, box, positive, negative, None)

    def refine(self, image, share):
        guess = share > 0.5
        if not guess.any():
            return guess
        band = guess.sum() ** 0.5
        positive = centres(eroded(share > SURE, 0.02 * band))
        negative = centres(eroded(share < 1 - SURE, 2 + 0.05 * band))
        box = bounds(centres(guess), 0.05, guess.shape, share=1.0)
        return self._predict(
            image, box, thinned(positive, self.most_points), thinned(negative, self.most_points), share
        )

    def _predict(self, image, box, positive, negative, share):
        with torch.no_grad():
            self.predictor.set_image(np.ascontiguousarray(image))
            points = np.concatenate([positive, negative]).astype(np.float32)
            signs = np.concatenate([np.ones(len(positive), int), np.zeros(len(negative), int)])
            masks, scores, _ = self.predictor.predict(
                point_coords=points if len(points) else None,
                point_labels=signs if len(points) else None,
                box=None if box is None else np.asarray(box, np.float32),
                mask_input=None if share is None else self._logits(share),
                # one click is ambiguous: take the candidate that the network itself trusts most
                multimask_output=box is None and len(points) == 1,
            )
        return masks[int(np.argmax(scores))].astype(bool)

    def _logits(self, share: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "1 a a"]:
        """The guess as the network takes an earlier answer of its own: a quarter of its image, -10 to 10."""
        import cv2

        side = self.image_size // 4
        return (20 * cv2.resize(share.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA) - 10)[None]

    @cached_property
    def model(self) -> Any:
        """The network of both predictors. Raises ValueError naming masker.config or masker.weights."""
        model = build_sam2(self.config, self.image_size)
        state = torch.load(sam2_weights(self.weights), map_location="cpu", weights_only=True)
        missing, unexpected = model.load_state_dict(state.get("model", state), strict=False)
        if missing or unexpected:
            raise ValueError(
                f"masker.weights={self.weights} does not fit masker.config={self.config} "
                f"({len(missing)} entries missing, {len(unexpected)} unexpected); choose the pair of one model"
            )
        return model.to(self.device).eval()

    @cached_property
    def predictor(self):
        from sam2.sam2_image_predictor import SAM2ImagePredictor

        predictor = SAM2ImagePredictor(self.model)
        predictor._bb_feat_sizes = [(self.image_size // k,) * 2 for k in (4, 8, 16)]  # written for 1024 px there
        return predictor


@dataclass(frozen=True, kw_only=True)
class Sam2Video(AbstractVideoMasker):
    """SAM 2's video predictor: what a person prompts in one photograph is followed along the path of the cameras."""

    still: Sam2 = field(default_factory=Sam2)  # for the prompted photograph, and to refine; the weights serve both

    @property
    def most_points(self) -> int:  # type: ignore[override]
        return self.still.most_points

    def __call__(self, image, *, box, positive, negative):
        return self.still(image, box=box, positive=positive, negative=negative)

    def refine(self, image, share):
        return self.still.refine(image, share)

    def follow(self, images, start, mask):
        import cv2

        with TemporaryDirectory() as folder:  # it reads frames from files only
            for i, image in enumerate(images):
                if not cv2.imwrite(f"{folder}/{i}.jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 97)):
                    raise OSError(
                        f"cannot write photographs for SAM 2 to {folder}; is the disk full? (TMPDIR=<folder>)"
                    )
            state = self.still.model.init_state(folder)
        self.still.model.add_new_mask(state, start, 1, mask)
        found: dict[int, np.ndarray] = {}
        for backwards in (False, True):
            for i, _, logits in self.still.model.propagate_in_video(state, start, reverse=backwards):
                size = images[i].shape[1::-1]
                found[i] = cv2.resize(logits[0, 0].float().cpu().numpy(), size, interpolation=cv2.INTER_LINEAR) > 0
        found[start] = mask
        return [found[i] for i in range(len(images))]


def build_sam2(config: str, image_size: int) -> torch.nn.Module:
    """The network with random weights. Raises ValueError listing the configurations if there is none of that name."""
    # the package initialises Hydra for itself when imported, which would end a Hydra application around us
    from hydra.core.singleton import Singleton

    state = Singleton.get_state()
    try:
        import sam2
        from hydra.utils import instantiate
        from omegaconf import OmegaConf
    finally:
        Singleton.set_state(state)
    folder = Path(sam2.__path__[0]) / "configs"
    file = folder / f"{config}.yaml"
    if not file.is_file():
        known = sorted(str(f.relative_to(folder).with_suffix("")) for f in folder.glob("sam2*/sam2*_hiera_?*.yaml"))
        raise ValueError(f"masker.config={config} is none of {', '.join(k for k in known if 'training' not in k)}")
    if image_size % 32 or image_size <= 0:
        raise ValueError(f"masker.image_size={image_size} must be a positive multiple of 32, 1024 as trained")
    tree = OmegaConf.load(file)
    tree.model.image_size = image_size
    # a subclass that adds nothing to the network: it serves the image predictor as well
    tree.model._target_ = "sam2.sam2_video_predictor.SAM2VideoPredictor"
    return instantiate(tree.model, _recursive_=True)


def sam2_weights(name: str) -> Path:
    """A local file, else the hub's cache, else one short try of the network. Raises ValueError with the key to set."""
    file = Path(name).expanduser()
    if file.is_file():
        return file
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    stored = f"{name.rpartition('/')[2].replace('-', '_')}.pt"
    remedy = (
        f"masker.weights={name} is neither a file, nor in the hub's cache, nor can it be fetched; set it to a "
        "downloaded sam2*.pt, or choose physics3d.segmentation.maskers.grabcut.GrabCut, which needs no weights"
    )
    try:
        return Path(hf_hub_download(name, stored, local_files_only=True))
    except LocalEntryNotFoundError:
        pass
    except HFValidationError as error:
        raise ValueError(remedy) from error
    if not hub_answers():
        raise ValueError(remedy)
    try:
        return Path(hf_hub_download(name, stored))
    except (HfHubHTTPError, OSError) as error:
        raise ValueError(remedy) from error
