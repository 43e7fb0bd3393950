"""Feature sets: data sets that carry an encoder's output in place of video, and say whose output it is."""

from collections.abc import Mapping

from .backbones import IMAGE_SIZE, Backbone

FEATURE_PREFIX = "observation.features."

DESCRIBED = ("backbone", "weights_sha256", "precision", "readout", "preprocessing")
"""What must agree between a feature set and the policy that reads it."""


def feature_key(camera: str) -> str:
    """Column that holds the encoded frames of `camera`, (D,) float32."""
    return FEATURE_PREFIX + camera


def describe(backbone: Backbone, weights_sha256: str, precision: str) -> dict[str, str]:
    """Say how features are made: the column's `info`, compared before a policy trains on them."""
    return {
        "backbone": backbone.name,
        "weights_sha256": weights_sha256,
        "precision": precision,
        "readout": backbone.readout,
        "preprocessing": (
            f"[0, 1], bicubic antialiased to {IMAGE_SIZE}x{IMAGE_SIZE} if of another size, "
            f"mean {list(backbone.mean)}, std {list(backbone.std)}"
        ),
    }


def check_features(column: Mapping, expected: Mapping[str, str], dim: int) -> None:
    """Refuse a feature column that another encoder made.

    Args:
        column: the column's entry in the data set's `features`.
        expected: `describe` of the policy's encoder.
        dim: length D of its features.

    Raises:
        ValueError: the column is described differently, or not at all.
    """
    found = column.get("info") or {}
    different = [
        f"{name} {found.get(name, 'not stated')} (the policy: {expected[name]})"
        for name in DESCRIBED
        if found.get(name) != expected[name]
    ]
    if tuple(column["shape"]) != (dim,):
        different.append(f"shape {tuple(column['shape'])} (the policy: {(dim,)})")
    if different:
        raise ValueError(
            f"The data set's features were not made by this policy's encoder: {'; '.join(different)}; "
            "encode the data set again with constructskill-encode or match the policy's backbone fields."
        )
