"""The published families of estimators, one module each, behind one interface."""
