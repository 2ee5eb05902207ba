//! Generated tables in `docs/redundancy.md`.

use std::string::String;
use std::{env, format, fs};

/// Compares the parts of the page between their markers with `tables`, pairs of a name and a text.
/// Writes them instead if `UPDATE_DOCS=1` is set.
pub(crate) fn check(tables: &[(&str, String)]) {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/redundancy.md");
    let page = fs::read_to_string(path).unwrap();
    let expected = tables.iter().fold(page.clone(), |page, (name, text)| {
        replaced(&page, name, text)
    });
    if env::var_os("UPDATE_DOCS").is_some() {
        fs::write(path, expected).unwrap();
    } else {
        assert!(
            page == expected,
            "docs/redundancy.md is out of date: UPDATE_DOCS=1 cargo test -p tandem-redundancy"
        );
    }
}

/// Returns the page with `text` between the markers of `name`.
fn replaced(page: &str, name: &str, text: &str) -> String {
    let (begin, end) = (
        format!("<!-- {name}:begin -->\n"),
        format!("<!-- {name}:end -->"),
    );
    let from = page
        .find(&begin)
        .unwrap_or_else(|| panic!("{begin}missing"))
        + begin.len();
    let to = page.find(&end).unwrap_or_else(|| panic!("{end} missing"));
    format!("{}{}{}", &page[..from], text, &page[to..])
}
