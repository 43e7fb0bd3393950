"""A data set through an encoder, once, and how a study trains on the result."""
