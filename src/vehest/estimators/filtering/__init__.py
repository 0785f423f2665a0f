"""Parts of filter estimators: the single track, unscented filters of cars, fits of tyres."""
