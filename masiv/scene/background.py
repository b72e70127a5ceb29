"""Masks by background subtraction: the probability that a pixel shows the object, not the empty scene of its view.

A view without the object has colour B at a pixel. A picture of it has noise: of the sensor, and of JPEG, which is
larger near the object, since a block with an edge in it is coded worse. Light may change between pictures, and the
object throws soft shadows. The object has colours that all views and frames share. Noise, shadows and colours are
learnt from the recording; a Markov random field then decides about neighbours together.

Pictures are (H, W, 3) RGB, masks (H, W) float32 in [0, 1].
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from masiv.scene.markov import smooth_labels

_BINS = 64
"""Of the histogram of the object's colours, along each channel."""
_DEGREES_OF_FREEDOM = 5.0
"""Of Student's t distribution of the noise: its tails allow for JPEG blocks, which are no Gaussian noise."""
_SHADOW_PRIOR, _DEEPEST_SHADOW = 0.15, 0.7
"""Prior probability that the background is in shadow, and the largest share of light that a shadow takes."""
_CAST_SD, _CAST_SD_NEAR = 2.0, 3.0
"""Standard deviation of the colour of a shadow about the scene's mean cast [grey levels], and near the object, which
throws its own colour into its shadow. Measured on path-traced scenes: 2 and 3 grey levels."""
_SHADOW_BLUR = 0.8
"""Standard deviation of the window in which the depth of a shadow is fitted [pixels]. A shadow has a sharp edge where
the object touches the ground. From 1.5 to 0.5 pixels the masks of five scenes change by 1 to 2 % of their area."""
_OUTLIER_SHARE = 0.3
"""Share of the object's colours that the histogram may not contain, since no confident pixel shows them."""
_LEAST_COVERAGE = 0.05
"""Of the object, in its prior probability: a picture counts as if it were cropped to twenty times the object. How much
of the empty scene a picture shows says nothing of the pixels near the object. Chosen with one scene in view, a ball
that is thrown across a room, and checked on five others, whose masks are as before within 0.002."""
_CLIP = 10.0
"""Log-odds of one pixel, at most: no model of noise is trusted beyond."""
_NEAR = 17
"""Diameter of the neighbourhood of the object [pixels], in which JPEG noise is larger: a block of 4:2:0 is 16 wide."""
_SMALLEST_COMPONENT = 0.02
_MAX_ROUNDS, _SETTLED = 10, 0.01
"""Rounds of masks and what is learnt from them, at most, and the relative change of the masks' area at which they end:
of a plain object the first masks hold a part, whose colours find the rest."""
_MAX_SAMPLES = 2_000_000
"""Pixels from which a covariance is estimated, at most: its relative error is then 0.1 %."""
_MAX_LIGHT_SAMPLES = 100_000
"""Pixels to which the gain and offset of a picture are fitted, at most."""
_MAX_COARSE = 500_000
"""Pixels of the picture in which the object is looked for, at most; a larger picture is reduced for that."""


@dataclass(frozen=True)
class Noise:
    """Covariances (3, 3) of a background's colour [grey levels²], far from and near the object."""

    far: np.ndarray
    near: np.ndarray


@dataclass(frozen=True)
class BackgroundModel:
    """What the pictures of a recording have in common.

    backgrounds: (H, W, 3) float32 for each view. correlated_pixels: how many pixels of a neighbourhood share their
    noise; log-odds are divided by that. shadow_cast (3,): share of light that a shadow takes from each channel
    over its mean. log_colours (_BINS, _BINS, _BINS): log density of the object's colours. prior: log-odds of the
    object.
    """

    backgrounds: dict[int, np.ndarray]
    noise: Noise
    correlated_pixels: float
    shadow_cast: np.ndarray
    log_colours: np.ndarray
    prior: float

    def mask(self, view: int, image: np.ndarray) -> np.ndarray:
        """The probability (H, W) float32 that a pixel of ``image`` shows the object; its share at the outline."""
        empty = self.backgrounds[view]
        light = _Light.of(image, empty)
        mask = np.zeros(image.shape[:2], np.float32)
        part = self._window_of(image, empty, light)
        if part is None:
            return mask
        picture, behind = light.removed(image[part]), empty[part]
        far = self._log_odds(picture, behind, self.noise.far, _CAST_SD)[0]
        coarse = largest_components(_blur(far, 1.5) > 0)
        if not coarse.any():
            return mask
        near = cv2.dilate(coarse.astype(np.uint8), np.ones((_NEAR, _NEAR), np.uint8))
        x, y, width, height = cv2.boundingRect(near)
        window = (slice(y, y + height), slice(x, x + width))
        mask[part][window] = self._near_object(picture[window], behind[window], far[window], near[window] > 0)
        return mask

    def _window_of(self, image: np.ndarray, empty: np.ndarray, light: _Light) -> tuple[slice, slice] | None:
        """Where the object may be in ``image``: all of a small picture. In a large one it is looked for in a reduced
        picture, whose pixels are means: their noise is no larger. None if there is nothing."""
        height, width = image.shape[:2]
        factor = math.ceil(math.sqrt(height * width / _MAX_COARSE))
        if factor == 1:
            return slice(0, height), slice(0, width)
        size = math.ceil(width / factor), math.ceil(height / factor)
        picture = light.removed(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        reduced = cv2.resize(empty, size, interpolation=cv2.INTER_AREA)
        found = largest_components(_blur(self._log_odds(picture, reduced, self.noise.far, _CAST_SD)[0], 1.5) > 0)
        if not found.any():
            return None
        x, y, w, h = cv2.boundingRect(found.astype(np.uint8))
        margin = 2 * _NEAR
        return (
            slice(max(y * factor - margin, 0), min((y + h) * factor + margin, height)),
            slice(max(x * factor - margin, 0), min((x + w) * factor + margin, width)),
        )

    def _near_object(self, picture: np.ndarray, empty: np.ndarray, far: np.ndarray, near: np.ndarray) -> np.ndarray:
        """``mask`` in a window around the object. ``far``: log-odds by the noise far from it; ``near`` bool."""
        log_odds = np.where(near, self._log_odds(picture, empty, self.noise.near, _CAST_SD_NEAR)[0], far)
        evidence = (np.clip(log_odds, -_CLIP, _CLIP) + self.prior) / self.correlated_pixels
        probability = smooth_labels(evidence.astype(np.float32), picture)
        kept = cv2.dilate(largest_components(probability > 0.5).astype(np.uint8), np.ones((3, 3), np.uint8))
        sd = math.sqrt(np.trace(self.noise.near) / 3)
        return (alpha_matte(probability, picture, empty, sd) * kept).astype(np.float32)

    def shadow(self, view: int, image: np.ndarray) -> np.ndarray:
        """The probability (H, W) that a pixel of the background is in shadow."""
        empty = self.backgrounds[view]
        picture = _Light.of(image, empty).removed(image)
        return self._log_odds(picture, empty, self.noise.far, _CAST_SD)[1]

    def _log_odds(
        self, picture: np.ndarray, empty: np.ndarray, covariance: np.ndarray, cast_sd: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log-odds (H, W) of the object before its prior, and the probability of shadow among background."""
        light = _log_student(picture - empty, covariance) + math.log(1 - _SHADOW_PRIOR)
        shade = empty * self.shadow_cast
        taken = _blur((shade * (empty - picture)).sum(-1), _SHADOW_BLUR)
        depth = taken / np.maximum(_blur((shade * shade).sum(-1), _SHADOW_BLUR), 1.0)
        shaded = empty - shade * np.clip(depth, 0.0, _DEEPEST_SHADOW)[..., None]
        # The depth of a shadow is fitted: its density is spread over the colours that a shadow can give.
        spread = _DEEPEST_SHADOW * np.linalg.norm(empty, axis=-1) / math.sqrt(2 * math.pi * np.trace(covariance) / 3)
        dark = _log_student(picture - shaded, covariance + cast_sd**2 * np.eye(3))
        dark += math.log(_SHADOW_PRIOR) - np.log(np.maximum(spread, 1.0))
        bin_of = np.clip(picture * (_BINS / 256), 0, _BINS - 1).astype(np.int32)
        on_object = self.log_colours[bin_of[..., 0], bin_of[..., 1], bin_of[..., 2]]
        return on_object - np.logaddexp(light, dark), 1 / (1 + np.exp(np.clip(light - dark, -30, 30)))


@dataclass(frozen=True)
class _Light:
    """Gain and offset of each channel (3,) of a picture relative to the empty scene, whose mean is ``middle`` (3,)."""

    gain: np.ndarray
    offset: np.ndarray
    middle: np.ndarray

    @classmethod
    def of(cls, picture: np.ndarray, empty: np.ndarray) -> _Light:
        """A robust line through the pixels: least squares with Cauchy weights. Without contrast in ``empty`` the gain
        stays near one."""
        step = max(2, math.ceil(math.sqrt(picture.shape[0] * picture.shape[1] / _MAX_LIGHT_SAMPLES)))
        lines = []
        for channel in range(3):
            x = empty[::step, ::step, channel].ravel().astype(np.float32)
            lines.append(_line(x, picture[::step, ::step, channel].ravel().astype(np.float32)))
        return cls(*np.array(lines).T)

    def removed(self, picture: np.ndarray) -> np.ndarray:
        """``picture`` (H, W, 3) as float32 in the light of the empty scene."""
        result = np.empty(picture.shape, np.float32)
        for channel in range(3):
            gain, offset, middle = (float(v[channel]) for v in (self.gain, self.offset, self.middle))
            # A pixel of the background has the colour of the empty scene after this.
            seen = picture[..., channel].astype(np.float32)
            result[..., channel] = (seen - offset - gain * middle) / max(gain, 0.1) + middle
        return result


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Gain, offset of y = gain x + offset, and the mean of x; see ``_Light.of``."""
    gain, offset = 1.0, float(np.median(y - x))
    middle = float(x.mean())
    for _ in range(8):
        error = y - gain * x - offset
        scale = 1.4826 * float(np.median(np.abs(error))) + 0.5
        weight = 1 / (1 + (error / (2 * scale)) ** 2)
        total = weight.sum()
        mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
        # A ridge with the weight of 1 % of the pixels at 30 grey levels keeps a plain background's gain near one.
        ridge = 0.01 * total * 30.0**2
        spread = (weight * (x - mean_x) ** 2).sum()
        gain = float(((weight * (x - mean_x) * (y - mean_y)).sum() + ridge) / (spread + ridge))
        offset = float(mean_y - gain * mean_x)
    return gain, offset, middle


@dataclass(frozen=True)
class _Pictures:
    """Some pictures of one view, (H, W, 3) uint8 each, which are floats only while they are looked at: those of many
    large views would fill the memory."""

    images: Sequence[np.ndarray]
    lights: Sequence[_Light]

    @classmethod
    def of(cls, images: Sequence[np.ndarray], plate: np.ndarray) -> _Pictures:
        return cls(images, [_Light.of(image, plate) for image in images])

    def __iter__(self) -> Iterator[np.ndarray]:
        return (light.removed(image) for image, light in zip(self.images, self.lights, strict=True))


def learn_background(images: Mapping[int, Sequence[np.ndarray]], plates: dict[int, np.ndarray]) -> BackgroundModel:
    """The model of a recording.

    images: pictures (H, W, 3) uint8 of each view with the object, some of the recording's. plates: a picture
    (H, W, 3) uint8 of each view without it.
    """
    pictures = {view: _Pictures.of(given, plates[view]) for view, given in images.items()}
    taken = {view: [_differs(p, plates[view]) for p in own] for view, own in pictures.items()}
    masks: dict[int, list[np.ndarray]] = {}
    uniform = np.full((_BINS,) * 3, -3 * math.log(256.0), np.float32)
    log_colours = uniform
    correlated = 1.0
    area = math.inf
    for learnt in range(_MAX_ROUNDS + 1):
        backgrounds = {view: _background(plates[view], own, taken[view]) for view, own in pictures.items()}
        noise = _noise(pictures, backgrounds, taken, masks)
        if learnt == 0:
            correlated = _correlated_pixels(pictures, backgrounds, taken)
        cast = _shadow_cast(pictures, backgrounds)
        coverage = np.clip(np.mean([np.mean(m) for m in (masks or taken).values()]), _LEAST_COVERAGE, 0.5)
        model = BackgroundModel(
            backgrounds, noise, correlated, cast, log_colours, float(np.log(coverage / (1 - coverage)))
        )
        before, area = area, float(sum(m.sum() for own in masks.values() for m in own)) if masks else math.inf
        if learnt == _MAX_ROUNDS or abs(area - before) <= _SETTLED * area < math.inf:
            return model
        masks = {v: [model.mask(v, p) for p in own] for v, own in pictures.items()}
        taken = {
            v: [np.maximum(m, model.shadow(v, p)) > 0.1 for m, p in zip(masks[v], own, strict=True)]
            for v, own in pictures.items()
        }
        log_colours = _log_colours(pictures, masks)
    raise AssertionError


def alpha_matte(probability: np.ndarray, picture: np.ndarray, empty: np.ndarray, sd: float) -> np.ndarray:
    """``probability`` with the pixels of its outline replaced by the share of the object in their colour.

    A pixel of the outline is I = a F + (1 - a) B. F and B are the mean colours of the object and of the background near
    it. The estimate counts by its variance ``sd``² / |F - B|² against 1/12, that of a uniform share.
    """
    square = np.ones((3, 3), np.uint8)
    inside = cv2.erode((probability > 0.5).astype(np.uint8), square).astype(np.float32)
    outside = cv2.erode((probability < 0.5).astype(np.uint8), square).astype(np.float32)
    weight_in, weight_out = _blur(inside, 1.5), _blur(outside, 1.5)
    colour = _blur(picture * inside[..., None], 1.5) / np.maximum(weight_in, 1e-3)[..., None]
    change = _blur((picture - empty) * outside[..., None], 1.5) / np.maximum(weight_out, 1e-3)[..., None]
    behind = empty + change
    contrast = colour - behind
    square_of = np.maximum((contrast * contrast).sum(-1), 1e-3)
    share = np.clip(((picture - behind) * contrast).sum(-1) / square_of, 0.0, 1.0)
    weight = 1 / (1 + 12 * sd**2 / square_of)
    band = (inside + outside == 0) & (weight_in > 0.02) & (weight_out > 0.02)
    return np.where(band, weight * share + (1 - weight) * probability, probability)


def largest_components(mask: np.ndarray) -> np.ndarray:
    """The components of ``mask`` (H, W) bool that are not smaller than 2 % of the largest one."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros(mask.shape, bool)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas >= _SMALLEST_COMPONENT * areas.max()))


def _blur(values: np.ndarray, sd: float) -> np.ndarray:
    return cv2.GaussianBlur(values, (0, 0), sd)


def _differs(picture: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Pixels that differ from the plate by more than its noise, and their neighbours: a first guess, with shadows."""
    difference = np.abs(_blur(picture - plate.astype(np.float32), 1.5)).max(axis=-1)
    limit = 4 * 1.4826 * float(np.median(difference)) + 2.0
    return cv2.dilate((difference > limit).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0


def _background(plate: np.ndarray, pictures: _Pictures, taken: Sequence[np.ndarray]) -> np.ndarray:
    """Mean of the plate and of the pictures where they show it: less noise than the plate alone has."""
    total, count = np.zeros(plate.shape, np.float32), np.ones(plate.shape[:2], np.float32)
    for picture, not_free in zip(pictures, taken, strict=True):
        free = cv2.dilate(not_free.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
        total += free[..., None] * picture
        count += free
    return (plate + total) / count[..., None]


def _sample_step(pictures: Mapping[int, Iterable[np.ndarray]]) -> int:
    """The stride through all pixels that leaves ``_MAX_SAMPLES`` of them, or all if they are fewer."""
    return math.ceil(
        sum(picture.shape[0] * picture.shape[1] for own in pictures.values() for picture in own) / _MAX_SAMPLES
    )


def _noise(
    pictures: dict[int, _Pictures],
    backgrounds: dict[int, np.ndarray],
    taken: dict[int, list[np.ndarray]],
    masks: dict[int, list[np.ndarray]],
) -> Noise:
    step = _sample_step(taken)
    square = np.ones((_NEAR, _NEAR), np.uint8)
    far, near = [], []
    for view, own in pictures.items():
        for k, picture in enumerate(own):
            residual, free = picture - backgrounds[view], ~taken[view][k]
            if view in masks:
                zone = cv2.dilate((masks[view][k] > 0.5).astype(np.uint8), square) > 0
                far.append(residual[free & ~zone][::step])
                near.append(residual[free & zone][::step])
            else:
                far.append(residual[free][::step])
    far_covariance = _covariance(np.concatenate(far))
    near_residual = np.concatenate(near) if near else np.empty((0, 3))
    enough = len(near_residual) > 1000
    near_covariance = _covariance(near_residual) if enough else 2 * far_covariance
    return Noise(far_covariance, near_covariance)


def _covariance(residual: np.ndarray) -> np.ndarray:
    """Covariance (3, 3) without outliers; at least that of rounding to whole grey levels."""
    if len(residual) < 100:
        return np.eye(3) * 4.0
    residual = residual - np.median(residual, axis=0)
    sd = 1.4826 * np.median(np.abs(residual), axis=0) + 0.3
    return np.cov(residual[(np.abs(residual) < 4 * sd).all(axis=1)].T) + np.eye(3) / 12


def _correlated_pixels(
    pictures: dict[int, _Pictures], backgrounds: dict[int, np.ndarray], taken: dict[int, list[np.ndarray]]
) -> float:
    """Sum of the autocorrelation of the noise over lags up to two pixels, 1 for white noise: of the median view."""
    found = []
    for view, own in pictures.items():
        residual, free = next(iter(own)) - backgrounds[view], ~taken[view][0]
        base = max(_correlation(residual, free, 0, 0), 1e-6)
        lags = [(0, 1), (0, 2), *((dy, dx) for dy in (1, 2) for dx in range(-2, 3))]
        found.append(1 + 2 * sum(max(_correlation(residual, free, *lag) / base, 0.0) for lag in lags))
    return max(1.0, float(np.median(found)))


def _correlation(residual: np.ndarray, free: np.ndarray, dy: int, dx: int) -> float:
    height, width = residual.shape[:2]
    one = (slice(max(0, dy), height + min(0, dy)), slice(max(0, dx), width + min(0, dx)))
    other = (slice(max(0, -dy), height - max(0, dy)), slice(max(0, -dx), width - max(0, dx)))
    both = free[one] & free[other]
    limit = 10.0  # grey levels: what is larger is no noise of the background
    first, second = np.clip(residual[one][both], -limit, limit), np.clip(residual[other][both], -limit, limit)
    return float((first * second).mean()) if len(first) else 0.0


def _shadow_cast(pictures: dict[int, _Pictures], backgrounds: dict[int, np.ndarray]) -> np.ndarray:
    """Share of light that shadows take from each channel over its mean, (3,): sky light makes shadows bluish."""
    taken_light, step = [], _sample_step({view: own.images for view, own in pictures.items()})
    for view, own in pictures.items():
        empty = np.maximum(_blur(backgrounds[view], 2.0), 4.0)
        for picture in own:
            ratio = _blur(picture, 2.0) / empty
            dimmed = (ratio.mean(-1) < 0.93) & (ratio.mean(-1) > 1 - _DEEPEST_SHADOW) & (np.ptp(ratio, axis=-1) < 0.12)
            taken_light.append(1 - ratio[dimmed][::step])
    found = np.concatenate(taken_light)
    if len(found) < 100:
        return np.ones(3)
    cast = np.median(found / found.mean(axis=1, keepdims=True), axis=0)
    return cast / cast.mean()


def _log_colours(pictures: dict[int, _Pictures], masks: dict[int, list[np.ndarray]]) -> np.ndarray:
    """Log density of the object's colours: a smoothed histogram of the pixels inside of its outline.

    Holes count as inside, so that colours which the background hides in one view are learnt there too.
    """
    counts = np.zeros((_BINS,) * 3)
    for view, own in pictures.items():
        for picture, mask in zip(own, masks[view], strict=True):
            solid = cv2.erode(_filled(mask > 0.5), np.ones((3, 3), np.uint8)) > 0
            bins = np.clip(picture[solid] * (_BINS / 256), 0, _BINS - 1).astype(np.int64)
            flat = np.ravel_multi_index(tuple(bins.T), counts.shape)
            counts += np.bincount(flat, minlength=counts.size).reshape(counts.shape)
    counts = ndimage.gaussian_filter(counts, 1.0, mode="constant")
    density = counts / max(counts.sum(), 1.0) / (256 / _BINS) ** 3
    return np.log((1 - _OUTLIER_SHARE) * density + _OUTLIER_SHARE / 256.0**3).astype(np.float32)


def _filled(mask: np.ndarray) -> np.ndarray:
    """``mask`` (H, W) bool without holes, uint8."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED)


def _log_student(residual: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Log density (...) of Student's t distribution with ``covariance`` (3, 3) at ``residual`` (..., 3)."""
    nu = _DEGREES_OF_FREEDOM
    whitened = residual @ np.linalg.cholesky(np.linalg.inv(covariance)).astype(np.float32)
    square = (whitened * whitened).sum(-1)
    constant = math.lgamma((nu + 3) / 2) - math.lgamma(nu / 2) - 1.5 * math.log((nu - 2) * math.pi)
    constant -= 0.5 * np.linalg.slogdet(covariance)[1]
    return constant - 0.5 * (nu + 3) * np.log1p(square / (nu - 2))
