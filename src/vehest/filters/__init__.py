"""Generic filters: batched, differentiable, and compiled where speed is the point; they know no
car.
"""
