"""The application: scene and bench files, control loop, interlocks, recorder, replay, console, command line."""
