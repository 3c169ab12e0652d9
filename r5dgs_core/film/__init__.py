"""Films: pictures of a scene along a camera path and over a range of times, written as a video or as frames."""
