"""What a recording is: channels, recordings, estimates, their store, transforms, splits and windows."""
