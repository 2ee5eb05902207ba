//! Checks that some code of the product produces each failure mode of the redundancy.

/// The file that names the modes.
const MODES: &str = "redundancy/src/state.rs";
/// The folders that produce them.
const PRODUCERS: [&str; 2] = ["redundancy/src/", "cores/src/"];
/// Modes that do not describe a fault that a system finds in itself.
const NO_FAULTS: [&str; 2] = ["None", "Unknown"];

/// Returns the modes that no code produces. `files`: all sources, with their texts.
pub(crate) fn findings(files: &[(String, String)]) -> Vec<String> {
    let is_source = |(place, _): &&(String, String)| {
        PRODUCERS.iter().any(|folder| place.starts_with(folder)) && place != MODES
    };
    let sources: Vec<&str> = files
        .iter()
        .filter(is_source)
        .map(|(_, text)| text.as_str())
        .collect();
    let modes = files.iter().find(|(place, _)| place == MODES);
    let without = modes.map(|(_, modes)| without_producer(modes, &sources));
    let finding = |mode| format!("{MODES}: nothing produces the failure mode {mode}");
    without
        .unwrap_or_default()
        .into_iter()
        .map(finding)
        .collect()
}

/// Returns the variants that the sources use only in comparisons. Tests do not count.
fn without_producer(modes: &str, sources: &[&str]) -> Vec<String> {
    let variants = modes
        .split("pub enum FailureMode {")
        .nth(1)
        .unwrap_or_default();
    let variants = variants.lines().take_while(|line| *line != "}");
    let names = variants.filter_map(|line| Some(line.trim().split_once(" = ")?.0));
    let is_produced = |name: &str| {
        let product = sources
            .iter()
            .filter_map(|text| text.split("#[cfg(test)]\nmod tests {").next());
        product.flat_map(str::lines).any(|line| {
            let compares = line.contains("==") || line.contains("!=");
            let comment = line.trim_start().starts_with("//");
            line.contains(&format!("FailureMode::{name}")) && !compares && !comment
        })
    };
    names
        .filter(|name| !NO_FAULTS.contains(name) && !is_produced(name))
        .map(str::to_owned)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mode_that_is_only_compared_or_tested_has_no_producer() {
        let modes = "pub enum FailureMode {\n    None = 0,\n    /// A.\n    A = 1,\n    B = 2,\n    C = 3,\n}\n";
        let sources = [
            "self.tell(FailureMode::A);\n// FailureMode::C\n",
            "if mode == FailureMode::B {}\n#[cfg(test)]\nmod tests { x(FailureMode::C) }\n",
        ];
        assert_eq!(without_producer(modes, &sources), ["B", "C"]);
    }
}
