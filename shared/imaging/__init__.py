"""Pictures and textures as arrays: colour, sampling where a surface point is seen, texels, displacement, detail.

Read in this order: material_labels, color, image_sampling, views, texture, texels, displacement, turning_eyes,
picture_detail, matte, frame_index, value_noise.
May import: compute, geometry.
"""
