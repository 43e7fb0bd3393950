"""Random features and tiny policies for these tests."""

from random_features import config, feature_set, other_set, tiny_weights  # noqa: F401
