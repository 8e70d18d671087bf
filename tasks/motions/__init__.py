"""Motions of the human: key poses, captured clips, random styles, and reference kicks made of them."""
