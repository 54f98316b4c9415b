"""What a clip says before any physics: flow, shapes, free decay, release, image modes."""
