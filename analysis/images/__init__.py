"""Image files as grey values: TIFF, FITS, PNG and JPEG."""
