"""A camera as optical designers look at it: wavefronts, spots, MTF, first-order data, distortion; refocusing."""
