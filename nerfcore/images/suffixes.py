"""Names by which photos and videos are known. Blender's side reads them too: nothing is imported here."""

RAW_SUFFIXES = {
    ".3fr", ".arw", ".cr2", ".cr3", ".dcr", ".dng", ".erf", ".iiq", ".kdc", ".mef", ".mos", ".mrw", ".nef", ".nrw",
    ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f",
}  # fmt: skip
CAMERA_SUFFIXES = {".jpg", ".jpeg", ".jpe", ".heic", ".heif", ".hif"}  # which cameras save beside raw files
FLOAT_SUFFIXES = {".exr", ".hdr"}
TIFF_SUFFIXES = {".tif", ".tiff"}
PHOTO_SUFFIXES = RAW_SUFFIXES | FLOAT_SUFFIXES | TIFF_SUFFIXES | {
    ".jpg", ".jpeg", ".jpe", ".png", ".webp", ".bmp", ".heic", ".heif", ".hif", ".avif", ".ppm", ".jp2", ".tga",
}  # fmt: skip
VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi", ".mts", ".m2ts", ".3gp", ".mpg", ".mpeg"}
