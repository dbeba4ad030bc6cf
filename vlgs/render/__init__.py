"""Pictures and video of a trained scene, from any cameras."""
