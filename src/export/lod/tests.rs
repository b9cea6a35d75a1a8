//! Merging keeps mass and moments, and files hold what they name.
