"""Experts (pure numpy), noise, and the recorder of demonstrations."""
