//! The documents and the rules of the repository.

mod kit;
mod readme;
mod tidy;
