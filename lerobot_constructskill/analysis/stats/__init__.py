"""Tests, intervals and power for outcomes per training seed; numbers in, numbers out."""
