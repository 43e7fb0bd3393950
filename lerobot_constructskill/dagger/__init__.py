"""DAgger (Ross et al. 2011): a learner drives, the scripted expert says what it would have done, and both are kept."""
