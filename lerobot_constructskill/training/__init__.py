"""How a policy is trained and its checkpoint kept: recipe, trainers, checkpoints in a store."""
