"""Reading what cameras give: photos, videos, raw files, EXIF, masks; and judging it."""
