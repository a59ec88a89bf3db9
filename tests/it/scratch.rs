#![allow(missing_docs)]
use vpd::solve::{hamiltonian::*, so::*, stepper::vpd::Vpd, tableau::Tableau, trajectory::*, nonlinear::*};
use nalgebra::*;
fn dipole() -> (RigidBody<3>, State<3>) {
    let d = [1.01f64, 1.0, 0.01];
    let dm = [(d[1]+d[2]-d[0])/2., (d[0]+d[2]-d[1])/2., (d[0]+d[1]-d[2])/2.];
    let w = Mat::<3>::from_fn(|i,j| if i==j {0.} else {1./(dm[i]+dm[j])});
    let e3 = Vector3::new(0.,0.,1.);
    let z = Vector3::new(0.,0.,-1.5);
    let b = RigidBody::new(Kinetic::Principal{weights:w}, vec![
      Term{law: Law::Uniform{weight:1., body_point:e3}, space:e3},
      Term{law: Law::PointSource{strength:1., body_point:Vector3::new(0.,0.1,-1.)}, space:z},
      Term{law: Law::PointSource{strength:-1., body_point:Vector3::new(0.,-0.1,-1.)}, space:z}], 0.0);
    let g = Matrix3::new(1.,0.,0.,0.,0.,-1.,0.,1.,0.);
    (b, State{attitude:g, momentum:hat(&[0.,0.,-0.01])})
}
struct Null; impl<const N:usize> Sink<N> for Null { type Error=(); fn record(&mut self,_:&Sample<'_,N>)->Result<(),()> {Ok(())}}
#[derive(Default)] struct Max{e:f64,o:f64,osum:f64,n:f64,m:f64}
impl Sink<3> for Max { type Error=(); fn record(&mut self,s:&Sample<'_,3>)->Result<(),()> {
  self.e=self.e.max(s.energy_error.unwrap().abs()); self.o=self.o.max(s.orthogonality_error.unwrap()); self.osum+=s.orthogonality_error.unwrap(); self.n+=1.; self.m=self.m.max(s.momentum_drift.unwrap()); Ok(())}}
#[test] fn go() {
    let (b,s0)=dipole();
    println!("H {:?}", b.energy(&s0).total());
    let gref=Matrix3::new(0.919821795106858499229182696092667428606822027,0.392336373745730085015481567567562557126594865,0.000187303089186229308809804296398191006624359607,0.0453466735328009092377835459844992035780277165,-0.105839795012169690006471542939923757221325104,-0.993348688523466805666301791179688057940625092,-0.389706998199809077216234641114915142082966297,0.913712267416735899910579487153724613540987692,-0.115144899697126436730310106540460399581757132);
    let pref=Vector3::new(0.429589824857234280339455434716070848349036718,0.182646388208405479256177851348873211152127106,-0.00458479358012003455319117133413114431910431961);
    let off=Observables{energy:false,orthogonality:false,momentum:false,sigma_min:false};
    for (name,t) in [("GL2",Tableau::gauss(1).unwrap()),("RK3",Tableau::rk3()),("GL4",Tableau::gauss(2).unwrap()),("GL6",Tableau::gauss(3).unwrap()),("GL8",Tableau::gauss(4).unwrap()),("GL16",Tableau::gauss(8).unwrap())] {
        for n in [2u64,4,8,16,32,64] {
            let mut st=Vpd::new(t.clone(),StopRule{tolerance:std::env::var("TOL").ok().and_then(|s|s.parse().ok()).unwrap_or(1e-15),max_iterations:100});
            let r=integrate(&b,&mut st,s0.clone(),Schedule{step_s:0.5/n as f64,steps:n,every:n},off,&mut Null,|_|true).unwrap();
            let p=vee(&r.state.momentum);
            let e=(Vector3::from_column_slice(&p)-pref).norm()+{ let d=r.state.attitude-gref; let m=(d.transpose()*d).symmetric_eigenvalues().max().max(0.).sqrt(); m};
            println!("{name} {n} err {e:.3e} its {:.1} {:?}", r.iterations as f64/ n as f64, if let Ending::Failed(f)=&r.ending {Some((f.code,f.measured,f.stage))} else {None});
        }
    }
    for (name,t,h) in [("GL2",Tableau::gauss(1).unwrap(),0.01),("RK3",Tableau::rk3(),0.01),("GL4",Tableau::gauss(2).unwrap(),0.01),("GL6",Tableau::gauss(3).unwrap(),1./26.),("GL6",Tableau::gauss(3).unwrap(),0.01)] {
        let on=Observables{energy:true,orthogonality:true,momentum:true,sigma_min:false};
        let mut st=Vpd::new(t.clone(),StopRule{tolerance:std::env::var("TOL").ok().and_then(|s|s.parse().ok()).unwrap_or(1e-15),max_iterations:100});
        let t0=std::time::Instant::now();
        let mut m=Max::default();
        let r=integrate(&b,&mut st,s0.clone(),Schedule{step_s:h,steps:100000,every:10},on,&mut m,|_|true).unwrap();
        println!("{name} h {h} E {:.2e} orth {:.2e} avg {:.2e} mom {:.2e} its {:.2} ns/step {:.0} {:?}", m.e,m.o,m.osum/m.n,m.m,r.iterations as f64/1e5,t0.elapsed().as_nanos() as f64/1e5, r.ending);
    }
}
