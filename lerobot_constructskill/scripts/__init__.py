"""Console commands: of each the configuration, and the function that it is handed to. No other room imports them."""
