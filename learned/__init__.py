"""The learned side: networks that take tensors and return tensors (torch); see variational for the conventions."""
