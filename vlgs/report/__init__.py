"""What a finished run says about itself: scores, speed, pictures, metrics.json and the summary on the terminal."""
