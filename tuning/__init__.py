"""The application: fits, reports, batch runs and the command line, on top of torchblur."""
