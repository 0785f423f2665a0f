"""Courses and their segments, lines across open areas, surfaces."""
