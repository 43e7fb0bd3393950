"""Two sides compared over training seeds: published rows, recordings, evaluations by LeRobot, or checkpoints."""
