"""Statistics of pictures while a video is written, exact and much faster than LeRobot's own."""

from functools import cache

import numpy as np

LEVELS = 256
"""Values of a pixel's channel."""


@cache
def running_statistics() -> type:
    """LeRobot's class of running statistics, which counts the values of pixels; all other numbers are as before.

    LeRobot's own sorts each picture's pixels into 5,000 bins, and again where a new one is darker or brighter.
    """
    from lerobot_constructskill.lerobot_internals import RunningQuantileStats

    class Statistics(RunningQuantileStats):
        counts: np.ndarray | None = None
        """(channels, 256), how often each value was seen."""

        def update(self, batch: np.ndarray) -> None:
            """Take pixels (N, channels), or other numbers."""
            if batch.dtype != np.uint8:
                super().update(batch)
            else:
                channels = batch.reshape(-1, batch.shape[-1]).T
                seen = np.stack([np.bincount(channel, minlength=LEVELS) for channel in channels])
                self.counts = seen if self.counts is None else self.counts + seen

        def get_statistics(self) -> dict[str, np.ndarray]:
            """Statistics of each channel, in the units of the pixels."""
            return super().get_statistics() if self.counts is None else statistics_of(self.counts, self._quantile_list)

    return Statistics


def statistics_of(counts: np.ndarray, quantiles: list[float]) -> dict[str, np.ndarray]:
    """Statistics as LeRobot names them.

    Args:
        counts: (channels, 256), how often each value was seen.
        quantiles: shares of pixels; the quantile is the value that at least so many do not exceed.
    """
    values, total = np.arange(LEVELS), counts.sum(axis=1)
    mean = counts @ values / total
    upto = counts.cumsum(axis=1)
    return {
        "min": (counts > 0).argmax(axis=1).astype(np.float64),
        "max": LEVELS - 1.0 - (counts[:, ::-1] > 0).argmax(axis=1),
        "mean": mean,
        "std": np.sqrt((counts * (values - mean[:, None]) ** 2).sum(axis=1) / total),
        "count": total[:1],
    } | {f"q{round(100 * q):02d}": (upto >= q * total[:, None]).argmax(axis=1).astype(np.float64) for q in quantiles}
