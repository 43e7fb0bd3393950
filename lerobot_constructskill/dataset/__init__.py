"""What one does with a data set that is there: checks, card, replay, plots, Hub."""
