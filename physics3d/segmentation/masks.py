"""One photograph and a prompt -> the pixels of the object: GrabCut needs no weights, SAM 2 is better where it has them.

Rother, Kolmogorov, Blake (2004), "GrabCut"; Ravi et al. (2024), "SAM 2". Pixel coordinates are (u, v), from the upper
left corner of the image, pixel centres at integer + 0.5.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from physics3d.priors.weights import hub_answers


class AbstractMasker:
    """A frozen dataclass; the call returns the mask, which may be empty (the caller knows which view and prompt)."""

    most_points: int  # of each sign that help; more are thinned by the caller

    def __call__(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        *,
        box: Float[np.ndarray, " 4"] | None,  # left, top, right, bottom [px]
        positive: Float[np.ndarray, "p 2"],  # points on the object [px]
        negative: Float[np.ndarray, "q 2"],  # points beside it [px]
    ) -> Bool[np.ndarray, "h w"]:
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class GrabCut(AbstractMasker):
    """Colour models of object and surroundings, separated by a minimum cut (OpenCV)."""

    iterations: int = 5
    most_points: int = 400

    def __call__(self, image, *, box, positive, negative):
        import cv2

        height, width = image.shape[:2]
        kinds = np.zeros((height, width), np.uint8)
        if box is None:
            # nothing but points: the object is what resembles their neighbourhood
            kinds[:] = cv2.GC_PR_BGD
            reach = max(2, round(0.03 * max(height, width)))
            near = slice(0, height), slice(0, width)
        else:
            left, top, right, bottom = np.round(np.clip(box, 0, [width, height, width, height])).astype(int)
            if right - left < 3 or bottom - top < 3:
                return np.zeros((height, width), bool)
            kinds[:] = cv2.GC_BGD
            kinds[top:bottom, left:right] = cv2.GC_PR_FGD
            reach = max(1, round(0.004 * max(height, width)))
            # the surroundings are what lies near the box: sharper colour models, and fewer pixels to cut
            du, dv = (right - left) // 2, (bottom - top) // 2
            near = slice(max(0, top - dv), bottom + dv), slice(max(0, left - du), right + du)
        for points, value in ((positive, cv2.GC_FGD), (negative, cv2.GC_BGD)):
            for u, v in np.floor(points).astype(int).tolist():
                cv2.circle(kinds, (u, v), reach, value, -1)
        guess = kinds[near].copy()
        is_object = lambda: np.isin(guess, (cv2.GC_FGD, cv2.GC_PR_FGD))
        # without any object or any surroundings there is no colour model to learn
        if is_object().any() and not is_object().all():
            cv2.setRNGSeed(0)
            models, pixels = (np.zeros((1, 65)), np.zeros((1, 65))), np.ascontiguousarray(image[near][..., ::-1])
            cv2.grabCut(pixels, guess, None, *models, self.iterations, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
        mask = np.zeros((height, width), np.uint8)
        mask[near] = is_object()
        closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        return without_specks(connected_to(closed.astype(bool), positive))


def connected_to(mask: Bool[np.ndarray, "h w"], positive: Float[np.ndarray, "p 2"]) -> Bool[np.ndarray, "h w"]:
    """The connected parts of a mask on which a positive point lies, and those a tenth as large as the largest."""
    from scipy import ndimage

    parts, count = ndimage.label(mask)
    if count == 0:
        return mask
    size = np.bincount(parts.reshape(-1))
    size[0] = 0
    keep = size >= 0.1 * size.max()
    if len(positive):
        u, v = np.floor(positive).astype(int).T
        touched = parts[np.clip(v, 0, mask.shape[0] - 1), np.clip(u, 0, mask.shape[1] - 1)]
        if touched.any():
            keep = np.bincount(touched, minlength=count + 1) > 0
    keep[0] = False
    return keep[parts]


def without_specks(mask: Bool[np.ndarray, "h w"], share: float = 0.02) -> Bool[np.ndarray, "h w"]:
    """The mask with its small holes filled, up to that share of its area each: eyes, buttons, highlights."""
    from scipy import ndimage

    holes, count = ndimage.label(~mask)
    if count == 0:
        return mask
    small = np.bincount(holes.reshape(-1)) <= share * mask.sum()
    edge = np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]])
    small[edge], small[0] = False, False
    return mask | small[holes]


@dataclass(frozen=True, kw_only=True)
class Sam2(AbstractMasker):
    """SAM 2's image predictor. `weights`: a .pt file, or the name of a repository of facebook/sam2* on the hub."""

    config: str = "sam2.1/sam2.1_hiera_t"  # a .yaml below the package's `configs`
    weights: str = "facebook/sam2.1-hiera-tiny"
    image_size: int = 1024  # side of the square the network sees [px]
    most_points: int = 8
    device: str = "cpu"

    def __call__(self, image, *, box, positive, negative):
        with torch.no_grad():
            self.predictor.set_image(np.ascontiguousarray(image))
            points = np.concatenate([positive, negative]).astype(np.float32)
            signs = np.concatenate([np.ones(len(positive), int), np.zeros(len(negative), int)])
            masks, scores, _ = self.predictor.predict(
                point_coords=points if len(points) else None,
                point_labels=signs if len(points) else None,
                box=None if box is None else np.asarray(box, np.float32),
                # one click is ambiguous: take the candidate that the network itself trusts most
                multimask_output=box is None and len(points) == 1,
            )
        return masks[int(np.argmax(scores))].astype(bool)

    @cached_property
    def predictor(self):
        """Raises ValueError naming segment.masker.config or segment.masker.weights."""
        model = build_sam2(self.config, self.image_size)
        state = torch.load(sam2_weights(self.weights), map_location="cpu", weights_only=True)
        missing, unexpected = model.load_state_dict(state.get("model", state), strict=False)
        if missing or unexpected:
            raise ValueError(
                f"segment.masker.weights={self.weights} does not fit segment.masker.config={self.config} "
                f"({len(missing)} entries missing, {len(unexpected)} unexpected); choose the pair of one model"
            )
        from sam2.sam2_image_predictor import SAM2ImagePredictor

        predictor = SAM2ImagePredictor(model.to(self.device).eval())
        predictor._bb_feat_sizes = [(self.image_size // k,) * 2 for k in (4, 8, 16)]  # written for 1024 px there
        return predictor


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
        raise ValueError(
            f"segment.masker.config={config} is none of {', '.join(k for k in known if 'training' not in k)}"
        )
    if image_size % 32 or image_size <= 0:
        raise ValueError(f"segment.masker.image_size={image_size} must be a positive multiple of 32, 1024 as trained")
    tree = OmegaConf.load(file)
    tree.model.image_size = image_size
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
        f"segment.masker.weights={name} is neither a file, nor in the hub's cache, nor can it be fetched; set it to a "
        "downloaded sam2*.pt, or choose physics3d.segmentation.masks.GrabCut, which needs no weights"
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
