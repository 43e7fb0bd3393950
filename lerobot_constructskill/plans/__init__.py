"""Walls as lists of placements: read, checked, drawn, measured, made of IFC files. Without simulator and LeRobot."""
