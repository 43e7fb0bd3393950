"""Statistics and report: rows and an analysis section in, page out. No torch, no simulator, no LeRobot."""
