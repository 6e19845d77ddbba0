//! Bundle adjustment by Levenberg-Marquardt on the Schur complement of the points, projective and metric.
