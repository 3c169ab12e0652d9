"""Motion representations of training: tracks, field and still, with residuals and regrouping."""
