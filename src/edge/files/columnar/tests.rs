use super::*;

fn fields() -> Vec<Field> {
    vec![
        Field::new("arrival", Kind::Time, "ns"),
        Field::new("sequence", Kind::Unsigned, ""),
        Field::new("count", Kind::Int, "").optional(),
        Field::new("p_a", Kind::Float, "mmHg").optional(),
        Field::new("exact", Kind::Float, ""),
        Field::new("text", Kind::Text, ""),
    ]
}

fn row(i: i64) -> Vec<Cell> {
    // NaN with a payload, infinities, -0.0, subnormals: whatever has bits.
    let odd = [f64::from_bits(0x7ff8_0000_0000_1234), f64::NEG_INFINITY, -0.0, f64::MIN_POSITIVE / 3.0, 0.1];
    let index = usize::try_from(i).unwrap();
    vec![
        Cell::Int(1_700_000_000_000_000_000 + i),
        Cell::unsigned(u64::MAX - index as u64),
        if i % 3 == 0 { Cell::Missing } else { Cell::Int(-i) },
        if i % 2 == 0 { Cell::Missing } else { Cell::Float(odd[index % 5]) },
        Cell::Float(odd[index % 5]),
        Cell::text(["", "p_a", "Größe, \"q\"\n"][index % 3]),
    ]
}

fn bits(batch: &Batch) -> Vec<String> {
    let float = |f: &Option<f64>| format!("{:?}", f.map(f64::to_bits));
    let column = |column: &Column| match column {
        Column::Int(cells) => format!("{cells:?}"),
        Column::Float(cells) => cells.iter().map(float).collect::<Vec<_>>().join(","),
        Column::Text(cells) => format!("{cells:?}"),
    };
    batch.columns().iter().map(column).collect()
}

#[test]
fn every_bit_comes_back_over_several_row_groups_with_units_and_metadata() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.parquet");
    let n = 2 * MAX_GROUP_ROWS + 100;
    let mut writer = Writer::create(&path, fields(), &[("more", "of it".to_owned())]).unwrap();
    let mut expected = Batch::new(&fields());
    for i in 0..i64::try_from(n).unwrap() {
        writer.row(row(i)).unwrap();
        expected.push(row(i));
    }
    assert!(!path.exists(), "no name before it is whole");
    let bytes = writer.finish().unwrap();
    assert_eq!(bytes, std::fs::metadata(&path).unwrap().len());

    let mut reader = Reader::open(&path).unwrap();
    assert_eq!(reader.fields(), fields());
    assert_eq!((reader.metadata(SCHEMA_KEY), reader.metadata("more")), (Some("1"), Some("of it")));
    assert_eq!(reader.rows(), n as u64);
    let mut read = Batch::new(&fields());
    while let Some(batch) = reader.next_batch(1000).unwrap() {
        assert!(batch.rows() <= 1000);
        read.append(batch);
    }
    assert!(bits(&read) == bits(&expected));
}

#[test]
fn what_is_no_table_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.parquet");
    let complaint = |path: &std::path::Path| Reader::open(path).err().unwrap().to_string();
    assert!(complaint(&path).contains("No such file"));
    for bytes in [&b""[..], b"PAR1", b"PAR1PAR1", b"time_s,p_a\n0,80\n", &[0; 100]] {
        std::fs::write(&path, bytes).unwrap();
        assert!(complaint(&path).contains("expected a Parquet file"), "{}", complaint(&path));
    }
    let mut writer = Writer::create(&path, fields(), &[]).unwrap();
    writer.row(row(0)).unwrap();
    writer.finish().unwrap();
    let whole = std::fs::read(&path).unwrap();
    // Damage anywhere is an error or other values, and no panic.
    for i in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[i] ^= 0x55;
        std::fs::write(&path, damaged).unwrap();
        if let Ok(mut reader) = Reader::open(&path) {
            while let Ok(Some(_)) = reader.next_batch(10) {}
        }
    }
}

#[test]
fn a_missing_cell_where_none_may_be_and_a_name_twice_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.parquet");
    let mut writer = Writer::create(&path, vec![Field::new("a", Kind::Float, "")], &[]).unwrap();
    writer.row([Cell::Missing]).unwrap();
    let error = writer.finish().unwrap_err().to_string();
    assert!(error.contains("a missing cell in column `a`"), "{error}");
    let twice = vec![Field::new("a", Kind::Int, ""), Field::new("a", Kind::Float, "")];
    assert!(Writer::create(&path, twice, &[]).err().unwrap().to_string().contains("two columns `a`"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}
