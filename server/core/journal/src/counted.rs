//! A count and its noun -> text for people.

/// A count with its noun: `1 map`, `2 maps`.
pub fn counted(count: u64, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}
