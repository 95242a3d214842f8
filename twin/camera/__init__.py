"""Analysis of one camera: first-order data, wavefronts, spots, MTF, colour, distortion, field curvature, refocusing."""
