"""Studies that re-create published papers, beside the library: found by entry point, as anybody's
own study is.
"""
