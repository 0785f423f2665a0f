"""What filter estimators share: the single track, unscented filters of cars, and fits of tyres."""
