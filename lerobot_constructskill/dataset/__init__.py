"""Reads finished data sets: checks, card, plots, Hub."""
