"""`--policy.type=frozen_vit`: encoder, readout, heads, and its trainer of many seeds. No simulator, no study."""
