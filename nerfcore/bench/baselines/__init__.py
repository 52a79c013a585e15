"""Other methods of the field, trained by the benchmark beside ours from the same photos and rays.

Each is written after its publication with the sizes given there. What is the same as in ours is ours: photos, rays, the
occupancy grid and its march, compositing of packed samples, small networks, Adam on touched rows of a grid.
"""
