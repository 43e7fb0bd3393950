"""How the cameras' frames are kept: LeRobot's encoders by name, and what a frame takes on the disk."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Video:
    """An encoder of LeRobot's.

    Args:
        bytes_per_image: what a frame takes with its rows, rounded up.
        encoder: fields of `lerobot.configs.RGBEncoderConfig`.
    """

    bytes_per_image: int
    encoder: dict[str, Any]


ONE_THREAD = "pools=none:frame-threads=1:info=0"
"""x265 with more threads, or with its note of the CPU, writes other bytes on another machine."""

CLOSED_GROUPS = "open-gop=0"
"""By default x265 lets frames refer to a later key frame; LeRobot's default decoder cannot read these at random."""

SMALL_BLOCKS = "ctu=16:rd=1"
"""Blocks of 16 pixels, with less tried in each, are faster than those of x265's fastest preset, and hardly larger."""

VIDEOS = {
    "av1": Video(3_000, {"crf": 18}),
    "lossless": Video(
        30_000,
        {
            "vcodec": "hevc",
            "pix_fmt": "gbrp",
            "crf": None,
            "g": 10,
            "preset": "ultrafast",
            "extra_options": {"x265-params": f"lossless=1:{SMALL_BLOCKS}:log-level=none:{ONE_THREAD}:{CLOSED_GROUPS}"},
        },
    ),
}
"""What `--video` can be; `benchmarks/video.py` measures what each costs."""
