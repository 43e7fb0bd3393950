"""Walls as lists of placements: read, checked, drawn, and made from IFC files."""
