"""One file a task: what is loaded, where it starts, when it is done."""
