"""One photograph and a prompt -> the pixels of the object: GrabCut needs no weights, SAM 2 is better where it has them.

Rother, Kolmogorov, Blake (2004), "GrabCut"; Ravi et al. (2024), "SAM 2". Pixel coordinates are (u, v), from the upper
left corner of the image, pixel centres at integer + 0.5.

A masker answers two questions: what a person points at (the call), and what the object is, given what other views
say of every pixel (`refine`). One that also follows a mask through a video has `follow`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from physics3d.priors.weights import hub_answers
from physics3d.segmentation.outline import outlined
from physics3d.segmentation.pixels import bounds, centres, eroded, thinned

SURE = 0.95  # share of a pixel above which it is the object's, and 1 - SURE below which it is not
UNLIKE = 15.0  # Lab units to the nearest sample: what is in the box and farther resembles nothing outside it


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

    def refine(self, image: UInt8[np.ndarray, "h w 3"], share: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """The mask, where `share` (0..1) of each pixel is the object's by a guess that is right but not sharp."""
        raise NotImplementedError


class AbstractVideoMasker(AbstractMasker):
    """A masker that can also carry a mask from one picture of a sequence to all others."""

    def follow(
        self, images: Sequence[UInt8[np.ndarray, "h w 3"]], start: int, mask: Bool[np.ndarray, "h w"]
    ) -> list[Bool[np.ndarray, "h w"]]:
        """Masks of pictures that follow each other along a path, from that of picture `start`."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class GrabCut(AbstractMasker):
    """Colour models of object and surroundings, separated by a minimum cut: OpenCV's, or near a guess our `outline`."""

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
            if len(positive) and len(negative):
                inside = slice(top, bottom), slice(left, right)
                kinds[inside] = np.where(
                    like_the_clicks(image, inside, near, positive, negative), cv2.GC_PR_FGD, cv2.GC_PR_BGD
                )
        for points, value in ((positive, cv2.GC_FGD), (negative, cv2.GC_BGD)):
            for u, v in np.floor(points).astype(int).tolist():
                cv2.circle(kinds, (u, v), reach, value, -1)
        mask = cut(image, kinds, near, self.iterations)
        closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        return without_specks(connected_to(closed.astype(bool), positive))

    def refine(self, image, share):
        """By `outline`, in the surroundings of the guess, and with small holes of the guess's own filled."""
        guess = share > 0.5
        if not guess.any():
            return guess
        left, top, right, bottom = bounds(centres(guess), 0.5, guess.shape, share=1.0).astype(int)
        near, mask = (slice(top, bottom), slice(left, right)), np.zeros_like(guess)
        mask[near] = outlined(image[near], share[near])
        return mask | (without_specks(mask) & guess)


def like_the_clicks(
    image: UInt8[np.ndarray, "h w 3"],
    inside: tuple[slice, slice],
    near: tuple[slice, slice],
    positive: Float[np.ndarray, "p 2"],
    negative: Float[np.ndarray, "q 2"],
) -> Bool[np.ndarray, "a b"]:
    """Pixels in the box that resemble a positive click more than a negative one or what surrounds the box.

    Distance is that to the nearest sample, in Lab colour and, weakly, in place: else what is clicked away but makes up
    much of the box would teach the colours of the object.
    """
    import cv2
    from scipy.spatial import cKDTree

    height, width = image.shape[:2]
    colour = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    rows, columns = np.indices((height, width))
    reach = 60.0 / max(inside[0].stop - inside[0].start, inside[1].stop - inside[1].start)  # Lab units per pixel
    feature = np.concatenate([colour, reach * columns[..., None], reach * rows[..., None]], -1)

    def under(points):
        marked = np.zeros((height, width), np.uint8)
        for u, v in np.floor(points).astype(int).tolist():
            cv2.circle(marked, (u, v), max(1, round(0.006 * max(height, width))), 1, -1)
        return marked > 0

    around = np.zeros((height, width), bool)
    around[near] = True
    around[inside] = False
    on, off = under(positive), under(negative)
    samples = feature[on], np.concatenate([feature[off], thinned(feature[around], 2000)])
    to_on, to_off = (cKDTree(s).query(feature[inside].reshape(-1, 5))[0] for s in samples)
    return ((to_on < to_off) | (to_off > UNLIKE)).reshape(feature[inside].shape[:2])


def cut(
    image: UInt8[np.ndarray, "h w 3"], kinds: UInt8[np.ndarray, "h w"], near: tuple[slice, slice], iterations: int
) -> Bool[np.ndarray, "h w"]:
    """The object by GrabCut in a part of the image; `kinds` are OpenCV's four classes of pixels."""
    import cv2

    guess = kinds[near].copy()
    is_object = lambda: np.isin(guess, (cv2.GC_FGD, cv2.GC_PR_FGD))
    # without any object or any surroundings there is no colour model to learn
    if is_object().any() and not is_object().all():
        cv2.setRNGSeed(0)
        models, pixels = (np.zeros((1, 65)), np.zeros((1, 65))), np.ascontiguousarray(image[near][..., ::-1])
        cv2.grabCut(pixels, guess, None, *models, iterations, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    mask = np.zeros(kinds.shape, bool)
    mask[near] = is_object()
    return mask


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
        """The network of both predictors. Raises ValueError naming segment.masker.config or segment.masker.weights."""
        model = build_sam2(self.config, self.image_size)
        state = torch.load(sam2_weights(self.weights), map_location="cpu", weights_only=True)
        missing, unexpected = model.load_state_dict(state.get("model", state), strict=False)
        if missing or unexpected:
            raise ValueError(
                f"segment.masker.weights={self.weights} does not fit segment.masker.config={self.config} "
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
        raise ValueError(
            f"segment.masker.config={config} is none of {', '.join(k for k in known if 'training' not in k)}"
        )
    if image_size % 32 or image_size <= 0:
        raise ValueError(f"segment.masker.image_size={image_size} must be a positive multiple of 32, 1024 as trained")
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
