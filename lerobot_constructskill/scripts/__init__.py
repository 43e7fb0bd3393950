"""Console commands, one file each: a configuration, and the call that it leads to. Nothing imports them."""
