"""Fitted estimators as C99 that a control unit runs, and networks as ONNX."""
