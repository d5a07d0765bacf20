"""SMPL's tree of joints, apart from the product's."""

# the parent of each of the 24 joints; the pelvis has none
PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
