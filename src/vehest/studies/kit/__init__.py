"""What every report of a comparison is made of: its runs, who may be called best, a front page,
warnings, and how it was made.
"""
