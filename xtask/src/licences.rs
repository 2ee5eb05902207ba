//! `cargo xtask licences`: the rules of `deny.toml` for licences and sources of dependencies.

use anyhow::{Context, Result, ensure};
use serde_json::Value;
use std::path::Path;

const CRATES_IO: &str = "registry+https://github.com/rust-lang/crates.io-index";

/// Checks every package of the lock file against `deny.toml`, with cargo alone: nothing is
/// installed or fetched.
pub(crate) fn run(root: &Path) -> Result<()> {
    let deny = std::fs::read_to_string(root.join("deny.toml")).context("deny.toml")?;
    let deny: toml::Table = deny.parse().context("deny.toml")?;
    let allowed = deny["licenses"]["allow"].as_array().context("allow")?;
    let allowed: Vec<&str> = allowed.iter().filter_map(toml::Value::as_str).collect();
    let arguments = [
        "metadata",
        "--format-version=1",
        "--locked",
        "--all-features",
    ];
    let output = crate::cargo(root, &arguments).output()?;
    ensure!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let metadata: Value = serde_json::from_slice(&output.stdout)?;
    let packages = metadata["packages"].as_array().context("no packages")?;
    let mut refused = Vec::new();
    for package in packages {
        let (name, source) = (&package["name"], &package["source"]);
        let licence = package["license"].as_str().unwrap_or_default();
        if !permits(licence, &allowed) {
            refused.push(format!("{name}: licence {licence:?}"));
        }
        if !source.is_null() && source != CRATES_IO {
            refused.push(format!("{name}: source {source}"));
        }
        let dependencies = package["dependencies"].as_array().into_iter().flatten();
        let any = dependencies.filter(|it| it["req"] == "*" && it["path"].is_null());
        refused.extend(
            any.filter(|_| source.is_null())
                .map(|it| format!("{name}: any version of {}", it["name"])),
        );
    }
    ensure!(
        refused.is_empty(),
        "not permitted by deny.toml:\n{}",
        refused.join("\n")
    );
    println!(
        "{} packages: licences and sources as deny.toml permits",
        packages.len()
    );
    Ok(())
}

/// Returns whether the allowed licences satisfy this SPDX expression. AND binds more tightly than
/// OR, which old manifests write as a slash.
fn permits(expression: &str, allowed: &[&str]) -> bool {
    let spaced = expression.replace('/', " OR ").replace(')', " ) ");
    let words: Vec<&str> = spaced.split_whitespace().collect();
    let text = words.join(" ");
    let Some((before, rest)) = text.rsplit_once('(') else {
        let mut choices = text.split(" OR ");
        return choices.any(|all| all.split(" AND ").all(|one| allowed.contains(&one)));
    };
    let Some((within, after)) = rest.split_once(')') else {
        return false;
    };
    // Replace the innermost brackets by an allowed licence, or by none.
    let known = allowed.first().filter(|_| permits(within.trim(), allowed));
    permits(
        &format!("{before} {} {after}", known.unwrap_or(&"none")),
        allowed,
    )
}

#[cfg(test)]
mod tests {
    use super::permits;

    #[test]
    fn expressions_are_judged_as_spdx_says() {
        let allowed = ["MIT", "Apache-2.0 WITH LLVM-exception", "BSD-3-Clause"];
        for (expression, expected) in [
            ("MIT", true),
            ("GPL-3.0", false),
            ("", false),
            ("GPL-3.0 OR MIT", true),
            ("GPL-3.0/MIT", true),
            ("GPL-3.0 AND MIT", false),
            ("(GPL-3.0 OR MIT) AND BSD-3-Clause", true),
            ("MIT OR GPL-3.0 AND GPL-2.0", true),
            ("Apache-2.0 WITH LLVM-exception", true),
            ("Apache-2.0", false),
            ("(MIT", false),
        ] {
            assert_eq!(permits(expression, &allowed), expected, "{expression}");
        }
    }
}
