"""The page of a study: findings, sentences, figures and templates. Its statistics come from `analysis/stats`."""
