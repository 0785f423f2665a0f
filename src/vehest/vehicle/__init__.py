"""Physics of the car in torch: parameters and models; gradients pass through."""
