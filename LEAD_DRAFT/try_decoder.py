import numpy as np, time, sys
from perception.messages.uart import *
from perception.messages.evidence import *
from perception.messages.decoder import *
from perception.types import Signal
def make(rng, packets, end_s, sigma, fps=30., exp=1e-3, drop=0., drift=0., phase=None, begin=0.):
    t=np.arange(begin+(rng.uniform(0,1/fps) if phase is None else phase), end_s, 1/fps)
    t=t[rng.random(t.size)>=drop]
    lev=np.ones(t.size)
    for st,w in packets:
        b=packet_bits(w, REPS); T=0.1*(1+drift)
        e=st+T*np.arange(len(b)+1); cum=np.r_[0,np.cumsum(b)]*T
        # lit integral
        F=lambda x: np.interp(x,e,cum)+np.minimum(x-st,0)+np.maximum(x-e[-1],0)
        lev=np.where((t+exp/2>st)&(t-exp/2<e[-1]),(F(t+exp/2)-F(t-exp/2))/exp,lev)
    y=lev+sigma*rng.standard_normal(t.size)
    s=np.full(t.size,sigma)
    return Signal('r1',1,t,np.full(t.size,exp),y,s,s)
REPS=int(sys.argv[1]) if len(sys.argv)>1 else 5
asig=float(sys.argv[2]) if len(sys.argv)>2 else 3.
n=int(sys.argv[3]) if len(sys.argv)>3 else 100
rng=np.random.default_rng(1)
ok=wrong=miss=extra=0; t0=time.time()
wire=Wire(repeats=REPS)
bad=[]
for i in range(n):
    w=int(rng.integers(128)); st=2+rng.uniform(0,.1)
    d=rng.uniform(-.015,.015)
    s=make(rng,[(st,w)],st+wire.packet_s+2.5,1/asig,drift=d)
    m=decode(s,wire,*( [float(sys.argv[4])] if len(sys.argv)>4 else []))
    g=[x for x in m if abs(x.start_s-st)<.2]
    ok+= any(x.word==w for x in g); wr=[x for x in m if x.word!=w]; wrong+=len(wr)>0
    if not any(x.word==w for x in g): bad.append((w,bool(aliases(w)),[(round(x.start_s-st,2),x.word,x.confidence) for x in m]))
print('ok',ok/n,'wrong',wrong/n,'s per',(time.time()-t0)/n); print(bad[:10])
if len(sys.argv)>5:
    rng=np.random.default_rng(3)
    s=make(rng,[(2.03,65)],10.,.1)
    import perception.messages.decoder as D
    d=D.Decoder(wire)
    orig=D.Decoder._judged
    def j(self,ev,st):
        r=orig(self,ev,st); o=np.argsort(-self._scored.score.max(1))[:6]
        print('judged',st,r, self._next_s, [(round(self._scored.start_s[k],2),round(self._scored.score[k].max(),1),self._scored.score[k].argmax()) for k in o]); return r
    D.Decoder._judged=j
    print(d.push(s)); print(d.finish())
