"""Generic filters, independent of cars: batched, differentiable, and compiled for speed."""
