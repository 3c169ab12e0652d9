"""Motion representations of training: tracks, field and static, with residuals and regrouping."""
