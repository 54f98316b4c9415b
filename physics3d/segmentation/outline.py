"""A blunt guess and the photograph -> the pixels of the object: GrabCut's energy, to which the guess belongs.

    E(x) = - sum_p x_p (prior + colour + halves)_p + sum_pq x_p (1 - x_q) g/|p - q| exp(-|c_p - c_q|^2 / (2 m))

over x_p = 1 on the object and 0 beside it; q are the eight neighbours of p, c is Lab colour, m the mean of the squares,
g = SMOOTH. The three are logarithms of odds: `prior` = ln s/(1 - s) of the guessed share s, `colour` compares how often
either side shows this colour in this region of the picture, and `halves` which of the colours that meet at the outline
is nearer, so that a pixel of mixed colour is the object's if half of it is covered. GrabCut (Rother et al. 2004) has
the second alone, with colours of the whole picture, and loses what the guess knew wherever colours are alike. The
minimum is exact (Boykov and Jolly 2001).
"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

WRONG = 0.02  # share of pixels far from the outline at which the guess may be wrong
COLOUR = 6.0  # colours closer than this are alike [Lab units]
REGIONS = 3  # along each side of the picture, with colours of their own
FAINT = 0.2  # weight of colours alike only within three times that
FEW = 15.0  # pixels of a side in a region, fewer of which say little of its colours
COLOURS = 500.0  # that a side may have
SMOOTH = 4.0  # price of a pixel's length of outline where nothing shows
MEET = 1.0  # reach of the colours that meet at the outline [px]
NOISE = 3.0  # standard deviation that every such colour has at least [Lab units]
MIXED = 0.1  # what a pixel next to the outline counts among the colours of its side
ROUNDS = 2  # the second learns colours from the outline of the first


def outlined(image: UInt8[np.ndarray, "h w 3"], share: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The object, where `share` (0..1) of each pixel is guessed to be its."""
    import cv2

    colour = cv2.cvtColor(np.ascontiguousarray(image).astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    belief = np.clip(share, WRONG, 1 - WRONG)
    prior = np.log(belief / (1 - belief))
    price = price_of_parting(colour)
    found = minimum_cut(prior + likelier(colour, np.maximum(0, 2 * share - 1), np.maximum(0, 1 - 2 * share)), *price)
    for _ in range(ROUNDS - 1):
        inner, outer = away_from_outline(found)
        on, off = np.where(inner, 1.0, MIXED * found), np.where(outer, 1.0, MIXED * ~found)
        found = minimum_cut(prior + likelier(colour, on, off) + nearer_half(colour, inner, outer), *price)
    return found


def likelier(
    colour: Float[np.ndarray, "h w 3"], on: Float[np.ndarray, "h w"], off: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """ln p(colour | object) / p(colour | beside it), from pixels that count `on` for the one and `off` for the other.

    Histograms by region, spread over like colours and regions; where a region hardly shows a side, both may have any.
    """
    from scipy import ndimage

    def spread(count, shades, regions):
        modes = ["constant"] * 3 + ["nearest"] * 2
        return ndimage.gaussian_filter(count, (shades,) * 3 + (regions,) * 2, mode=modes, truncate=2.5)

    height, width = on.shape
    rows, columns = np.indices(on.shape)
    shade = ((colour - colour.min((0, 1))) / COLOUR).astype(int)
    cell = np.stack([*np.moveaxis(shade, 2, 0), rows * REGIONS // height, columns * REGIONS // width]).reshape(5, -1)
    shape = tuple(cell.max(1) + 1)
    place = np.ravel_multi_index(tuple(cell), shape)
    sides = []
    for weight in (on, off):
        count = np.bincount(place, weights=weight.reshape(-1), minlength=int(np.prod(shape))).reshape(shape)
        count = spread(count, 1.0, 0.7)
        sides.append(count + FAINT * spread(count, 3.0, 0.0))
    shown = [side.sum((0, 1, 2), keepdims=True) for side in sides]
    novel = FEW / (np.minimum(*shown) + FEW)  # alike, so that a colour that neither side has shown says nothing
    often = [(1 - novel) * side / np.maximum(n, 1e-9) + novel / COLOURS for side, n in zip(sides, shown)]
    return np.log(often[0] / often[1]).reshape(-1)[place].reshape(on.shape)


def away_from_outline(mask: Bool[np.ndarray, "h w"]) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The pixels inside and those outside whose neighbours all are there too."""
    from scipy import ndimage

    inner, outer = (ndimage.binary_erosion(side, np.ones((3, 3)), border_value=1) for side in (mask, ~mask))
    return inner, outer


def nearer_half(
    colour: Float[np.ndarray, "h w 3"], inner: Bool[np.ndarray, "h w"], outer: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """The logarithm of odds by the colours a and b that meet at the outline: (c - (a + b)/2) (a - b)/v, v the sum of
    the variances of the three channels and NOISE^2.

    Both are means over what is near but not next to it, so that their half is where half a pixel is covered. 0 except
    next to the outline, and where the object or its surroundings are too thin.
    """
    from scipy import ndimage

    near = lambda x: ndimage.gaussian_filter(x, (MEET, MEET) + (0,) * (x.ndim - 2), truncate=3)
    means, variances, known = [], [], ~inner & ~outer
    for side in (inner, outer):
        weight = near(side.astype(np.float32))
        total = near(np.concatenate([colour, (colour**2).sum(-1, keepdims=True)], -1) * side[..., None])
        mean = total / np.maximum(weight, 1e-6)[..., None]
        means.append(mean[..., :3])
        variances.append(np.maximum(0, mean[..., 3] - (mean[..., :3] ** 2).sum(-1)))
        known &= weight > 0.01
    (a, b), variance = means, np.mean(variances, 0) + NOISE**2
    odds = ((colour - (a + b) / 2) * (a - b)).sum(-1) / variance
    return np.where(known, np.clip(odds, -SMOOTH, SMOOTH), 0.0)


def price_of_parting(
    colour: Float[np.ndarray, "h w 3"],
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Neighbours (index, index) in the grid of 8, and what an outline between them costs: less where colours change."""
    height, width = colour.shape[:2]
    index, flat, pairs, length = np.arange(height * width).reshape(height, width), colour.reshape(-1, 3), [], []
    for dv, du in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here, there = slice(max(0, -du), width - max(0, du)), slice(max(0, du), width + min(0, du))
        pairs.append(np.stack([index[: height - dv, here].reshape(-1), index[dv:, there].reshape(-1)]))
        length.append(np.full(pairs[-1].shape[1], np.hypot(dv, du)))
    (p, q), away = np.concatenate(pairs, 1), np.concatenate(length)
    contrast = ((flat[p] - flat[q]) ** 2).sum(1)
    return p, q, SMOOTH / away * np.exp(-contrast / max(2 * float(contrast.mean()), 1e-9))


def minimum_cut(
    evidence: Float[np.ndarray, "h w"],
    p: Int[np.ndarray, " m"],
    q: Int[np.ndarray, " m"],
    price: Float[np.ndarray, " m"],
) -> Bool[np.ndarray, "h w"]:
    """x that minimises - sum x evidence + sum price [x_p != x_q]: what the source of a maximal flow still reaches."""
    from scipy import sparse
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count, gain = evidence.size, evidence.reshape(-1)
    source, sink = count, count + 1
    on, off = np.flatnonzero(gain > 0), np.flatnonzero(gain < 0)
    capacity = np.concatenate([price, price, gain[on], -gain[off]])
    start = np.concatenate([p, q, np.full(len(on), source), off])
    end = np.concatenate([q, p, on, np.full(len(off), sink)])
    whole = np.round(1000 * capacity).astype(np.int32)  # flows are of integers
    graph = sparse.csr_matrix((whole, (start, end)), shape=(count + 2, count + 2))
    left = graph - maximum_flow(graph, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    found = np.zeros(count + 2, bool)
    found[breadth_first_order(left, source, return_predecessors=False)] = True
    return found[:count].reshape(evidence.shape)
