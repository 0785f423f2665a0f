"""A module a family or group of families: what its template in ``templates/methods`` needs of a fitted estimator."""
