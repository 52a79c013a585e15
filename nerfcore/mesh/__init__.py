"""From a trained field to a textured mesh with classes.

Where the constants of these modules come from: the weight behind a surface, depths moved by photos (`VIEWS` of `refine`), the
share of a map that the field renders (`FIELD_SHARE`), planes, `SMOOTHNESS` of the choice of photos and `CHUNK_FACES` were compared
with others, with their figures in docs/experiments.md (“A mesh from depth maps…”, “Planes where photos say nothing…”,
“Textures from the photos”). The others that change a mesh were set once, by reasoning on a simulated room, and not tuned;
chunks, blocks and tiles only bound the memory.
"""
