"""The published families of estimators, one module each, behind one interface and a registry of
names.
"""
