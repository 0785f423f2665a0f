"""What is driven on: courses and their segments, lines across open areas, surfaces."""
