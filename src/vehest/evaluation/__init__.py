"""How good an estimate is: metrics on a common grid of times."""
