"""Random features and tiny policies for these tests."""

from random_features import config, tiny_weights  # noqa: F401
