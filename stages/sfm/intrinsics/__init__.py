"""Photographs whose intrinsics differ although one camera took them: zoomed, cropped, focused nearer, stabilised."""
