//! Signs the programs of a platform: `tandem exec sign`. E-4

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context as _, anyhow};
use serde_json::json;
use tandem_boot_host::SigningKey;
use tandem_exec_host::trust::sign;
use tandem_manifest::Manifest;
use tandem_page::json::{JsonOption, JsonOutput};
use tandem_processes::boot::{PRIVATE_DER, key};

use crate::failure::Failure;

/// What is signed, and by which key.
#[derive(Clone, Debug, clap::Args)]
pub struct SignArgs {
    /// The manifest; the list of parts is written beside it, as MANIFEST.parts
    manifest: PathBuf,
    /// The private key: `openssl genpkey -algorithm ed25519 -outform DER -out FILE`
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// The number of the key in the anchor's list, from 0
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    key_number: u8,
    /// Raise it to retire older lists, and `lowest-counter` in the anchor after that
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    counter: u32,
    #[command(flatten)]
    json: JsonOption,
}

/// Signs, and prints each part and the public key.
///
/// # Errors
/// [`Failure::Usage`] if a file cannot be read, a part cannot be found, or a program cannot start
/// from checked bytes.
pub fn run(args: &SignArgs) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    let text = signed(args, json_to).map_err(Failure::Usage)?;
    Ok(crate::print(&text)?)
}

fn signed(args: &SignArgs, json_to: JsonOutput) -> anyhow::Result<String> {
    let shown = args.manifest.display();
    let bytes = std::fs::read(&args.manifest).with_context(|| shown.to_string())?;
    let manifest = Manifest::read(&bytes).with_context(|| shown.to_string())?;
    let processes = manifest.processes.iter().map(|plan| plan.program.clone());
    let safe = [&manifest.safe_state.before, &manifest.safe_state.after];
    let safe = safe.into_iter().filter_map(|words| words.first());
    let programs: Vec<PathBuf> = processes.chain(safe.map(PathBuf::from)).collect();
    let key = SigningKey {
        number: args.key_number,
        seed: key(&args.key, &PRIVATE_DER)?,
    };
    let signature = |message: &[u8]| key.sign(message);
    let parts = sign(
        &args.manifest,
        &programs,
        args.counter,
        key.number,
        signature,
    );
    // The text names the reason already, which is also the source.
    let parts = parts.map_err(|error| anyhow!("{error}"))?;
    let public = key.public().map(|byte| format!("{byte:02x}")).concat();
    let mut text = String::new();
    for part in &parts {
        let kind = format!("{:?}", part.kind).to_lowercase();
        writeln!(
            text,
            "{kind:8} {:>10} {} {}",
            part.length, part.sha256, part.path
        )?;
    }
    writeln!(
        text,
        "{} parts signed by key {}: {public}",
        parts.len(),
        key.number
    )?;
    let all = json!({ "key_number": key.number, "public_key": public, "parts": parts });
    Ok(json_to.write(&all, || text)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use std::fs;
    use std::path::Path;
    use tandem_exec_host::trust::Platform;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        args: SignArgs,
    }

    /// E-4: all programs of a manifest are signed, also those of the safe state, and a changed
    /// manifest is refused after that.
    #[test]
    fn a_signed_platform_is_trusted_until_it_changes() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let text = concat!(
            "version = 1\ninitial = \"drive\"\n",
            "[safe-state]\nafter = [\"/bin/sh\", \"-c\", \"exit\"]\n",
            "[[process]]\nname = \"it\"\nprogram = \"it\"\n",
            "[[target]]\nname = \"drive\"\nprocesses = [\"it\"]\n",
        );
        fs::write(path("m.toml"), text).unwrap();
        fs::copy("/bin/cat", path("it")).unwrap();
        fs::write(path("key.der"), [&PRIVATE_DER[..], &[4; 32]].concat()).unwrap();
        let line = ["sign", "--counter", "3", "--key"].map(PathBuf::from);
        let files = ["key.der", "m.toml"].map(path);
        let args = Line::parse_from(line.iter().chain(&files)).args;
        let said = signed(&args, JsonOutput::default()).unwrap();
        let public = said.trim_end().rsplit(' ').next().unwrap();
        let anchor = format!("mode = \"strict\"\nlowest-counter = 3\nkeys = [\"{public}\"]\n");
        fs::write(path("anchor.toml"), anchor).unwrap();
        let open = || Platform::open(&path("m.toml"), Some(&path("anchor.toml")));
        let platform = open().unwrap();
        for program in ["it", "/bin/sh"] {
            assert!(platform.command(Path::new(program)).is_ok(), "{program}");
        }
        assert!(platform.command(Path::new("/bin/cat")).is_err());
        fs::write(path("m.toml"), text.replace("drive", "parks")).unwrap();
        assert!(open().is_err());
        fs::write(path("key.der"), [4; 32]).unwrap();
        let said = signed(&args, JsonOutput::default())
            .unwrap_err()
            .to_string();
        assert!(said.contains("not an Ed25519 key in DER"), "{said}");
    }
}
