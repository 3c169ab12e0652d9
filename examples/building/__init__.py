"""What the scene builders of this folder share: materials, shapes, toys, motion by laws, and the capture of a scene."""
