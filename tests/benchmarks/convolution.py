"""A convolutional network of the kind that others train to read a phase from images; only its time is measured."""

import numpy as np


class ConvolutionalNetwork:
    """U-Net from images (n_images, n, n) to a phase (n, n), with random weights; n is a multiple of 4."""

    def __init__(self, n_images=2, channels=(32, 64, 128), seed=0):
        rng, (fine, middle, coarse) = np.random.default_rng(seed), channels
        layers = [
            (n_images, fine), (fine, fine), (fine, middle), (middle, middle), (middle, coarse), (coarse, coarse),
            (coarse + middle, middle), (middle, middle), (middle + fine, fine), (fine, fine),
        ]  # fmt: skip
        self.weights = [
            (rng.normal(size=(after, 9 * before)) / np.sqrt(9 * before)).astype(np.float32)
            for before, after in layers
        ]
        self.last = rng.normal(size=fine).astype(np.float32)

    @property
    def n_weights(self):
        return sum(weight.size for weight in self.weights) + self.last.size

    def __call__(self, images):
        weights = iter(self.weights)

        def twice(maps):
            return _convolved(_convolved(maps, next(weights)), next(weights))

        fine = twice(images)
        middle = twice(_halved(fine))
        coarse = twice(_halved(middle))
        middle = twice(np.concatenate([_doubled(coarse), middle]))
        fine = twice(np.concatenate([_doubled(middle), fine]))
        return np.tensordot(self.last, fine, 1)


def _convolved(maps, weight):
    """Convolution with kernels of 3 x 3 points, and the positive part."""
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)))
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), (1, 2)).transpose(0, 3, 4, 1, 2)
    result = weight @ around.reshape(weight.shape[1], -1)
    return np.maximum(result, 0, out=result).reshape(-1, *maps.shape[1:])


def _halved(maps):
    n, size, _ = maps.shape
    return maps.reshape(n, size // 2, 2, size // 2, 2).max(axis=(2, 4))


def _doubled(maps):
    return maps.repeat(2, axis=1).repeat(2, axis=2)
